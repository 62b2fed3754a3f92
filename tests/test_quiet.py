"""The package's functions return, write files and log; only the command line prints."""

import shutil

import pytest
from analytic import write_scene

import univoxel
from univoxel.config import StageConfig, TrainConfig
from univoxel.lights import SGConfig
from univoxel.ops import PointLight
from univoxel.scene import SceneConfig
from univoxel.tasks.info import info


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("quiet")
    data = write_scene(folder / "data", views=6, size=16)
    light = SGConfig(lobes=1, hidden=4, directions=8, directions_eval=8)
    scene = SceneConfig(channels=2, material_channels=1, hidden=4, light=light, sky_nodes=0)
    stage = StageConfig(0.004, 10, 1.0, 64, physical_from=0.5)
    return univoxel.train(TrainConfig(data, folder / "run", (stage,), minutes=1.0, scene=scene))


def test_nothing_is_printed(run, tmp_path, capsys):
    """Paths may be text, too."""
    capsys.readouterr()
    data, cut, here = run.parent / "data", tmp_path / "cut", str(run)
    masks = tmp_path / "masks"
    masks.mkdir()
    for photograph in data.glob("*/*.png"):  # whose alpha counts
        shutil.copy(photograph, masks)
    assert univoxel.evaluate(here, save=str(tmp_path / "test"))["nvs_psnr"] > 0
    light = PointLight((0.0, 0.0, 3.0), (9.0, 9.0, 9.0))
    assert len(univoxel.relight(here, point_lights=[light], samples=1)) == 2
    univoxel.export(here, str(tmp_path / "a.ply"))
    assert univoxel.cutout(str(data), str(cut), str(masks)) == cut
    assert info(here)["bytes"] > 0
    assert capsys.readouterr() == ("", "")
