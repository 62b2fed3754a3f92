"""Configurations in which nothing is decided by itself, for tests of something else."""

from functools import partial

import pytest

from univoxel.cli import trainer
from univoxel.config import StageConfig, TrainConfig
from univoxel.fields.grid import GridShape
from univoxel.lights import SGConfig
from univoxel.scene import SceneConfig

# On dense grids, with rates for few steps; no patches, and no physically based render unless asked
plain_stage = partial(
    StageConfig,
    sharpness=(0.5, 0.5),
    lr_sdf=(0.2, 0.02),
    lr_networks=(3e-3, 3e-4),
    physical_from=1.0,
    patches_from=1.0,
    field="dense",
)
# Masks and cameras as given, a light that stands still, sizes as asked, no carving
plain_training = partial(
    TrainConfig,
    masks="given",
    cameras="given",
    exposures=False,
    light_frame="world",
    detail="none",
    carving_seconds=0.0,
    capacity="fixed",
)


# Networks that are trained in a moment
small_scene = partial(
    SceneConfig,
    channels=4,
    material_channels=2,
    hidden=16,
    light=SGConfig(lobes=4, hidden=16, directions=32, directions_eval=64),
)


def interrupt_second_stage(cfg: TrainConfig) -> list[GridShape]:
    """Train by the first stage, and no further; the grids that it had."""
    original, grids = trainer.run_stage, []

    def run_stage(scene, *rest):
        if grids:
            raise KeyboardInterrupt
        grids.append(scene.field.grid)
        original(scene, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trainer, "run_stage", run_stage)
        with pytest.raises(KeyboardInterrupt):
            trainer.train(cfg)
    return grids
