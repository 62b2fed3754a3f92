"""The measure of how fast a machine is."""

from pathlib import Path

import pytest
import torch

from univoxel.presets import preset
from univoxel.render.pipeline import surface_at
from univoxel.training import probe
from univoxel.training.loop import batch_at


def test_it_makes_steps_and_draws_nothing(monkeypatch):
    monkeypatch.setattr(probe, "REFERENCE", 1.0)  # then seconds of a step are what it returns
    before = torch.random.get_rng_state()
    seconds = probe.slowdown(preset("fast", Path("photos"), Path("run")), seconds=0.2)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert 1e-4 < seconds < 60


def test_the_sphere_is_what_its_photographs_show():
    """Or the steps would be those of an empty scene."""
    photos, scene = probe._sphere()
    scene.inv_s = 1 / (0.5 * scene.field.voxel_size)  # as the loop begins
    batch = batch_at(photos, photos.alpha.nonzero().int())
    surface = surface_at(scene, batch.rays)
    assert surface.opacity.mean() > 0.95


def test_a_training_of_seconds_is_not_worth_it(monkeypatch):
    monkeypatch.setattr(probe, "run_stage", pytest.fail)
    monkeypatch.setattr(probe, "expected_seconds", lambda stage: 1.0)
    assert probe.slowdown(preset("draft", Path("photos"), Path("run"))) == 1.0
