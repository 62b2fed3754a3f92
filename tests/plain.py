"""Configurations in which nothing is decided by itself, for tests of something else."""

from functools import partial

from univoxel.config import StageConfig, TrainConfig

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
