"""Measures the speed of this machine, to predict the time of a training."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from univoxel.camera import Cameras
from univoxel.config import StageConfig, TrainConfig
from univoxel.data import Photos
from univoxel.fields.field import PER_LEVEL, Levels, hash_field
from univoxel.fields.grid import fit_grid
from univoxel.lights import SGConfig
from univoxel.scene import Scene, SceneConfig
from univoxel.training.clock import expected_seconds
from univoxel.training.loop import run_stage
from univoxel.training.pixels import TrainingPixels

SECONDS = 1.0  # of steps that are measured
WARM = 3  # steps before them, in which memory is allocated and tables are built
# Trainings that are expected to take less are not worth a second of measuring
WORTH = 20.0
STAGE = StageConfig(0.25, 1000, share=1.0, rays=1024, physical_from=0.0, patches_from=1.0)
# Seconds of a step of it on the machine that `expected_seconds` is of
REFERENCE = 0.0315
VIEWS, SIZE, RADIUS = 8, 64, 0.5  # photographs, their sides in pixels, the sphere's radius


def slowdown(cfg: TrainConfig, seconds: float = SECONDS) -> float:
    """How many times as long as `expected_seconds` steps take here and now.

    Trains on a grey sphere for a moment, with the loop that the training runs. Draws nothing from
    torch's generator. 1.0 where the whole training is expected to take a few seconds only.
    """
    if sum(map(expected_seconds, cfg.stages)) < WORTH:
        return 1.0
    steps = _Stopwatch(seconds)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        photos, scene = _sphere()
        inside = photos.alpha.nonzero().int()
        pixels = TrainingPixels(photos, inside, inside[:64])
        run_stage(scene, TrainConfig(Path(), Path(), (STAGE,)), STAGE, pixels, steps)
    return steps.seconds_a_step / REFERENCE


def _sphere() -> tuple[Photos, Scene]:
    """A grey sphere seen from a circle, and the scene that it is."""
    poses = torch.zeros(VIEWS, 3, 4)
    for view in range(VIEWS):
        turn = 2 * math.pi * view / VIEWS
        x, y = math.cos(turn), math.sin(turn)
        # Columns: right, up, backwards, place
        poses[view] = torch.tensor([[-y, 0, x, 2 * x], [x, 0, y, 2 * y], [0, 1, 0, 0]])
    focal, centre = torch.full((VIEWS, 2), 1.5 * SIZE), torch.full((VIEWS, 2), SIZE / 2)
    cameras = Cameras(poses, focal, centre, SIZE, SIZE)
    row, column = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
    away = torch.stack([row, column]).add(0.5 - SIZE / 2).square().sum(0).sqrt()
    disc = away < 1.5 * SIZE * RADIUS / math.sqrt(4 - RADIUS**2)
    alpha = (255 * disc.byte()).expand(VIEWS, -1, -1).contiguous()
    color = torch.full((VIEWS, SIZE, SIZE, 3), 128, dtype=torch.uint8)
    photos = Photos(Path(), [str(view) for view in range(VIEWS)], color, alpha, cameras)

    side = torch.full((3,), 1.2 * RADIUS)
    grid = fit_grid(-side, side, round(1e6 * STAGE.voxels))
    config = SceneConfig(light=SGConfig(directions=128))
    levels = Levels.of(grid.bounds(), grid.voxel_size, config.channels // PER_LEVEL)
    return photos, Scene(config, hash_field(grid, levels, grid.nodes().norm(dim=-1) - RADIUS))


class _Stopwatch:
    """Steps for a number of seconds, off the record: a clock and a listener in one."""

    def __init__(self, seconds: float) -> None:
        self.stage: int = 0
        self.step: int = 0
        self.seconds_a_step: float = math.nan
        self._seconds = seconds

    @property
    def clock(self) -> _Stopwatch:
        return self

    def steps(self) -> Iterator[float]:
        for _ in range(WARM):
            yield 0.5
            self.step += 1
        begin = time.monotonic()
        while (spent := time.monotonic() - begin) < self._seconds:
            yield 0.5
            self.step += 1
        self.seconds_a_step = spent / max(self.step - WARM, 1)

    def due(self) -> bool:
        return False

    def checkpoint_due(self) -> bool:
        return False

    def state(self) -> dict[str, Any]:
        return {}

    def shorten(self) -> None: ...

    def abandon(self) -> None: ...

    def report(self, losses: dict[str, float], psnr: float | None) -> None: ...

    def trouble(self, what: str) -> None: ...
