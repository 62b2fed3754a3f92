"""Training with cameras that are off by some: they are put right, and kept with the scene."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic import LIGHTS, RADIUS, cameras_around, write_scene
from plain import interrupt_second_stage, plain_stage, plain_training, small_scene

from lab.stress.damage import turned
from univoxel.camera import project
from univoxel.cli import trainer as task
from univoxel.cli.trainer import train
from univoxel.config import TrainConfig
from univoxel.data import load_photos
from univoxel.data.transforms import write_cameras
from univoxel.evaluation.confidence import survey
from univoxel.preparation import pose_refinement
from univoxel.preparation.prepare import find_silhouettes
from univoxel.render.pipeline import extract_mesh
from univoxel.scene import load_scene


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """The sphere in 12 photographs of 32 x 32 pixels, each camera turned by some 1.4 pixels."""
    folder = write_scene(tmp_path_factory.mktemp("turned") / "data")
    photos = load_photos(folder, "train")
    write_cameras(
        folder, "train", turned(photos.cameras, 1.6, np.random.default_rng(0)), photos.names
    )
    return folder


def config(data, out, cameras="auto") -> TrainConfig:
    stages = (
        plain_stage(voxels=0.01, iterations=80, share=0.5, rays=256),
        plain_stage(voxels=0.02, iterations=80, share=0.5, rays=256, physical_from=0.5),
    )
    options = {"cameras": cameras, "scene": small_scene(), "voxel_pixels": 0.0}
    return plain_training(data, out, stages, minutes=2.0, **options)


@pytest.fixture(scope="module")
def run(data, tmp_path_factory):
    return train(config(data, tmp_path_factory.mktemp("turned") / "run"))


def off(cameras):
    """Pixels that the sphere's centre is off, in each view, but for what all share in space."""
    truth = cameras_around(12)
    pairs = [[project(c, v, torch.zeros(1, 3))[0] for c in (cameras, truth)] for v in range(12)]
    return torch.cat([a - b for a, b in pairs]).norm(dim=1)


def test_turned_cameras_are_put_right(data, run):
    photos = load_photos(data, "train")
    before, after = off(photos.cameras), off(load_scene(run).registered(photos).cameras)
    assert before.mean() > 1.0
    assert after.mean() < 0.3 * before.mean()
    assert load_scene(run).cfg.refined
    assert json.loads((run / "config.json").read_text())["cameras"] == "auto"


def test_cameras_that_agree_or_are_given_stay_as_they_are(data, tmp_path, caplog):
    caplog.set_level("INFO", "univoxel")
    right = write_scene(tmp_path / "data")
    for folder, cameras in ((right, "auto"), (data, "given")):
        cfg = config(folder, tmp_path / cameras, cameras)
        assert load_scene(train(replace(cfg, stages=cfg.stages[:1]))).poses is None
        if cameras == "auto":
            assert "inconsistent" not in caplog.text
    assert "pixels: try cameras=refined" in caplog.text


def test_geometry_is_the_sphere_again(data, run, tmp_path):
    away = [
        (extract_mesh(load_scene(r)).vertices.norm(dim=1) - RADIUS).abs().mean()
        for r in (run, train(config(data, tmp_path / "run", cameras="given")))
    ]
    assert away[0] < 0.03  # as from the true cameras, see test_train
    assert away[1] > away[0]


def test_a_refined_run_is_resumed(data, tmp_path, monkeypatch):
    """From a checkpoint after the first stage: the box and the cameras are as they were."""
    monkeypatch.setattr(pose_refinement, "STEPS", 10)
    cfg = config(data, tmp_path / "run", cameras="refined")
    interrupt_second_stage(cfg)
    before = load_scene(cfg.out).poses.steps
    seen = []
    monkeypatch.setattr(task, "run_stage", lambda scene, *_: seen.append(scene.field.grid))
    train(cfg, resume=True)
    torch.testing.assert_close(load_scene(cfg.out).poses.steps, before)
    box = find_silhouettes(load_photos(data, "train"), cfg).box
    assert seen == [task.fit_grid(*box, 20000)]


@pytest.mark.parametrize("light", LIGHTS, ids=lambda light: light.kind)
def test_cameras_are_refined_under_every_light(data, tmp_path, monkeypatch, light):
    """The directions to them have gradients, then, and what is drawn under the light takes some."""
    monkeypatch.setattr(pose_refinement, "STEPS", 10)
    cfg = config(data, tmp_path / "run", cameras="refined")
    stage = replace(cfg.stages[1], iterations=5, physical_from=0.0)
    cfg = replace(cfg, stages=(stage,), scene=replace(cfg.scene, light=light, sky_nodes=0))
    scene = load_scene(train(cfg))
    assert scene.poses.steps.isfinite().all()
    assert scene.cfg.refined


def test_trust_looks_from_where_the_cameras_are(data, run):
    """As it would if they had been put there from the start, and not from where they were."""
    scene, photos = load_scene(run), load_photos(data, "train")
    refined, moved = survey(scene, photos, 200), scene.registered(photos)
    scene.poses.steps.data.zero_()
    there, before = survey(scene, moved, 200), survey(scene, photos, 200)
    torch.testing.assert_close(refined.disagreement, there.disagreement)
    assert (before.disagreement - there.disagreement).abs().mean() > 1e-3
