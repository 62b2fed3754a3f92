"""The package's functions return, write files and log; only the command line prints."""

import shutil

import univoxel
from univoxel.cli.info import info
from univoxel.ops import PointLight


def test_nothing_is_printed(tiny_copy, tmp_path, capsys):
    """Paths may be text, too."""
    capsys.readouterr()
    data, cut, here = tiny_copy / "data", tmp_path / "cut", str(tiny_copy / "run")
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
