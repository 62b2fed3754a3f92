"""Held-out quality that does not rise any more, on made-up curves."""

import dataclasses

import pytest
from plain import plain_stage, plain_training

from univoxel.cli.trainer import train
from univoxel.lights import SGConfig
from univoxel.scene import SceneConfig, load_checkpoint
from univoxel.training.descent import CHECK, WINDOW, Plateau


def looks(patience, quality, steps=1000, physical_from=0.0):
    """Progress at the looks, and where the plateau was seen."""
    plateau, when, flat = Plateau(patience), [], []
    for i in range(steps):
        done = i / steps
        if plateau.due(done):
            when.append(done)
            if plateau.flat(done, quality(done), done >= physical_from):
                flat.append(done)
    return when, flat


def test_rising_quality_is_no_plateau():
    when, flat = looks(0.1, lambda done: 20 + 10 * done)
    assert not flat
    assert len(when) == pytest.approx(1 / CHECK, abs=1)


def test_a_plateau_is_seen_once_and_then_nothing_is_looked_at():
    when, flat = looks(0.1, lambda done: 20 + 10 * min(done, 0.4))
    assert flat == [when[-1]]
    assert 0.4 < flat[0] <= 0.4 + (WINDOW + 1) * CHECK


def test_another_kind_of_render_counts_anew():
    _, flat = looks(0.1, lambda done: 20 + 10 * done - 9 * (done > 0.5), physical_from=0.5)
    assert not flat


def test_without_patience_nothing_is_looked_at():
    assert looks(0.0, lambda done: 20.0) == ([], [])


def test_a_training_that_gains_too_little_is_shortened(data, tmp_path):
    light = SGConfig(lobes=2, hidden=8, directions=16, directions_eval=16)
    stage = plain_stage(voxels=0.008, iterations=60, share=1.0, rays=128, physical_from=0.0)
    sizes = SceneConfig(4, material_channels=2, hidden=8, sky_nodes=16, light=light)
    cfg = plain_training(data, tmp_path / "run", (stage,), minutes=2.0, scene=sizes, patience=50.0)
    state = load_checkpoint(train(cfg))[1]
    assert state["early"] == [0]
    assert state["made"][0] < 0.6
    cfg = dataclasses.replace(cfg, patience=0.0, out=tmp_path / "whole")
    assert load_checkpoint(train(cfg))[1]["made"] == [1.0]
