"""The least that a training by all stages takes, and one that all tests share."""

import json
import shutil
from dataclasses import replace

import pytest
from analytic import write_scene
from plain import plain_stage, plain_training

from univoxel.cli import main
from univoxel.cli.trainer import train
from univoxel.config import JointConfig, TrainConfig
from univoxel.lights import SGConfig
from univoxel.scene import SceneConfig, load_scene

CHANGES = (
    *(f"stages.{i}.{name}" for i in (0, 1, 3) for name in ("voxels=0.004", "rays=64")),
    *(f"stages.{i}.iterations=2" for i in (0, 2, 3)),
    *("stages.1.iterations=20", "stages.1.physical_from=0.0"),
    *("stages.2.rays=64", "stages.2.points=64", "stages.2.newton_points=8"),
    *("scene.sky_nodes=32", "stages.2.newton_steps=1"),
    *("scene.material_channels=1", "scene.channels=2", "scene.hidden=4"),
    *("scene.light.lobes=1", "scene.light.hidden=4", "scene.light.directions=8"),
)
# The same of the two stages of a light of lobes
OF_LOBES = (
    *(f"stages.{i}.{field}" for i in (0, 1) for field in ("voxels=0.004", "rays=64")),
    *("stages.0.iterations=2", "stages.1.iterations=8", "stages.1.physical_from=0.0"),
    *("scene.material_channels=1", "scene.channels=2", "scene.hidden=4"),
    *("scene.light.lobes=1", "scene.light.hidden=4", "scene.light.directions=8"),
)
OPTIONS = ["--no-page", *(f"--set={change}" for change in CHANGES)]


def three_stages(data, out, iterations=12, light=None, **sizes) -> TrainConfig:
    """Training of a moment: 12 steps, 6 of the joint stage, 4 that refit."""
    light = light or SGConfig(lobes=2, hidden=8, directions=16, directions_eval=16)
    stage = plain_stage(voxels=0.008, iterations=iterations, share=0.4, rays=128, physical_from=0.5)
    joint = JointConfig(iterations=6, rounds=2, points=100, newton_points=50, rays=64, tracing=1)
    refit = replace(stage, iterations=4, refit=True, physical_from=0.0)
    options = {"channels": 4, "material_channels": 2, "hidden": 8, "sky_nodes": 16} | sizes
    scene = SceneConfig(light=light, **options)
    return plain_training(data, out, (stage, joint, refit), minutes=60.0, scene=scene)


@pytest.fixture(scope="session")
def tiny(tmp_path_factory):
    """A folder with a data set of a sphere, `data`, and what was trained on it for a moment, `run`.

    All tests of a process share it: one that changes something of it changes a copy.
    """
    folder = tmp_path_factory.mktemp("tiny")
    data = write_scene(folder / "data", views=6, size=16)
    assert main(["train", str(data), "--out", str(folder / "run"), *OPTIONS]) == 0
    return folder


@pytest.fixture(scope="session")
def plain(data, tmp_path_factory):
    """What `three_stages` make of the sphere where nobody looks on."""
    return load_scene(train(three_stages(data, tmp_path_factory.mktemp("plain") / "run")))


@pytest.fixture
def tiny_copy(tiny, tmp_path):
    """The same in a folder of the test's own; the run knows of it."""
    for name in ("data", "run"):
        shutil.copytree(tiny / name, tmp_path / name)
    path = tmp_path / "run" / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"data": str(tmp_path / "data")}))
    return tmp_path
