"""What a training will need, against what the machine leaves: said before the kernel says it."""

from __future__ import annotations

import logging
import math

from univoxel import memmap
from univoxel.config import StageConfig, TrainConfig
from univoxel.data import Photos
from univoxel.errors import UserError
from univoxel.machine import Memory, memory
from univoxel.training.pixels import MOST

# Bytes, as trainings on 13 to 133 million pixels, 0.25 to 4 million voxels, were seen to take
PER_PIXEL = 23  # distances, masks, orders, brightness, besides the photographs themselves
PER_DRAWN = 48  # of a pixel that is trained on, where the photographs lie on disk: its row, twice
PER_VOXEL = 100  # distances and features with gradients and moments, hulls, meshes
PER_RAY = 40_000  # of a step: samples and what is between them

log: logging.Logger = logging.getLogger("univoxel")


def needed(photos: Photos, cfg: TrainConfig) -> int:
    """Bytes, about, that training takes besides the photographs, which are there already."""
    if memmap.on_disk(photos.color):
        return needed_for(0, cfg) + PER_DRAWN * MOST
    return needed_for(photos.alpha.numel(), cfg)


def needed_for(pixels: int, cfg: TrainConfig) -> int:
    """`needed`, of so many pixels in all photographs."""
    stages = [stage for stage in cfg.stages if isinstance(stage, StageConfig)]
    return round(
        PER_PIXEL * pixels
        + PER_VOXEL * 1e6 * max(stage.voxels for stage in stages)
        + PER_RAY * max(stage.rays for stage in stages)
    )


def check_memory(photos: Photos, cfg: TrainConfig, there: Memory | None = None) -> None:
    """Say so where memory may be short.

    Args:
        there: what the machine has; None: that is looked up.

    Raises:
        UserError: training needs more than the machine has in all, or grants this process.
    """
    there = memory() if there is None else there
    if there is None:
        return
    further = needed(photos, cfg)
    have = 0 if memmap.on_disk(photos.color) else photos.color.nbytes + photos.alpha.nbytes
    left = there.total if there.free is None else there.free
    if further <= left:
        return
    factor = _factor(photos, further, left)
    what = (
        f"training on {len(photos)} photographs of {photos.cameras.width}x{photos.cameras.height} "
        f"pixels needs about {(further + have) / 1e9:.1f} GB, of {there.total / 1e9:.1f} GB "
        f"{left / 1e9:.1f} are free"
    )
    change = f"downscale={factor}" if factor else "preset=draft"
    if further + have > there.total:
        raise UserError(f"{what}: pass {change}", "downscale", "preset")
    log.warning(
        "%s: if it is ended by the system, pass %s or close other programs",
        *(what, change),
        extra={"arguments": ("downscale", "preset")},
    )


def _factor(photos: Photos, further: int, left: int) -> int | None:
    """How many pixels of the files have to become one along a side; None: that is not enough."""
    pixels = PER_PIXEL * photos.alpha.numel()
    rest = left - (further - pixels)
    if rest <= 0:
        return None
    return math.ceil(photos.downscale * math.sqrt(pixels / rest))
