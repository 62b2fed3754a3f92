"""The training loop's losses, and the sharpness that it ends with."""

import json
import math
from dataclasses import fields
from types import SimpleNamespace

import pytest
import torch
from analytic import write_scene

from univoxel.config import TrainConfig
from univoxel.lights import SGConfig
from univoxel.lights.base import Regularisation
from univoxel.scene import SceneConfig
from univoxel.tasks.train import train
from univoxel.training import loop, progress
from univoxel.training.config import LossConfig, StageConfig
from univoxel.training.loop import weighted
from univoxel.training.pixels import TrainingPixels


def test_every_term_of_a_light_has_its_own_weight():
    names = [f.name for f in fields(Regularisation)]
    weight = LossConfig(**{name: float(2 + i) for i, name in enumerate(names)})
    prior = Regularisation(**{name: torch.tensor(10.0) for name in names})
    assert weighted(prior, weight) == {name: 10.0 * (2 + i) for i, name in enumerate(names)}
    assert weighted(Regularisation(white_light=torch.tensor(1.0)), weight).keys() == {"white_light"}


@pytest.mark.parametrize("best", [0.7, 1.0, 1.4])
def test_the_density_ends_as_sharp_as_held_out_pixels_want_it(monkeypatch, best):
    scene, asked = SimpleNamespace(inv_s=10.0), []

    def quality(scene, photos, pixels, physical):
        assert physical
        asked.append(scene.inv_s)
        return -abs(math.log(scene.inv_s / (10.0 * best)))

    monkeypatch.setattr(loop, "held_out_psnr", quality)
    loop.fit_sharpness_(scene, TrainingPixels(None, None, None))
    assert scene.inv_s == pytest.approx(10.0 * best)
    assert min(asked) < 10 < max(asked)


def test_masks_whose_edges_were_moved_do_not_tell_how_sharp_the_density_is(monkeypatch):
    scene = SimpleNamespace(inv_s=10.0)
    monkeypatch.setattr(loop, "held_out_psnr", lambda scene, *_, **__: scene.inv_s)
    loop.fit_sharpness_(scene, TrainingPixels(None, None, None, edges_given=False))
    assert scene.inv_s == 10.0
    loop.fit_sharpness_(scene, TrainingPixels(None, None, None))
    assert scene.inv_s == 20.0


def test_patches_are_compared_in_every_second_step_and_told_in_all(tmp_path, monkeypatch):
    compared = []

    def disagreement(scene, brightness, cameras, surface, *_):
        compared.append(len(surface.depth))
        return 0.5 + 0 * surface.depth.sum()

    monkeypatch.setattr(loop.patches, "disagreement", disagreement)
    monkeypatch.setattr(progress, "REPORT_SECONDS", -1.0)
    data = write_scene(tmp_path / "data", views=8, size=24)
    light = SGConfig(lobes=4, hidden=16, directions=32, directions_eval=64)
    sizes = SceneConfig(channels=4, material_channels=2, hidden=16, sky_nodes=0, light=light)
    stage = StageConfig(voxels=0.01, iterations=20, share=1.0, rays=64, patches_from=0.42)
    cfg = TrainConfig(data, tmp_path / "run", (stage,), minutes=2.0, scene=sizes)
    train(cfg)
    assert len(compared) == 5
    lines = [json.loads(line) for line in (cfg.out / "log.jsonl").read_text().splitlines()]
    told = [line["losses"].get("patches") for line in lines]
    assert told == [None] * 10 + [pytest.approx(0.5 * cfg.loss.patches)] * 10
