"""The pixels that training uses, and the memory that it needs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from univoxel.config import StageConfig, TrainConfig
from univoxel.core import log, memmap
from univoxel.core.machine import Memory, memory
from univoxel.data import Photos
from univoxel.data.photos import packed, packed_width
from univoxel.errors import UserError

MARGIN = 6.0  # pixels around the silhouettes that are trained on; farther ones are empty
MOST = 1 << 24  # pixels that are trained on, at most
SPARE = 2  # times the rays that a training draws: as many pixels as it has use for
EDGE = 3.0  # pixels beside silhouettes of rough masks: they do not tell how good a render is
HELD_OUT = 2048  # pixels of the training photographs that are only looked at, to follow quality


@dataclass(frozen=True)
class TrainingPixels:
    """Photographs, and which of their pixels serve what.

    Pixels are rows of int32: view, row and column, and, of photographs that lie on disk, the stored
    colour and alpha after them, as `packed` has them.
    """

    photos: Photos
    trained: Tensor  # [P, 3 and more]
    held_out: Tensor  # only looked at, to follow quality
    edges_given: bool = True  # whether masks are as given, and none of their edges doubted


def most_pixels(cfg: TrainConfig) -> int:
    """How many pixels a training has use for, at most: a random part of more is as good."""
    stages = [stage for stage in cfg.stages if isinstance(stage, StageConfig)]
    return min(MOST, SPARE * sum(stage.iterations * stage.rays for stage in stages))


def split_pixels(
    photos: Photos, distance: Tensor, doubted: Tensor | None = None, most: int = MOST
) -> TrainingPixels:
    """The pixels in or near silhouettes: those to train on, and some that are held out.

    Args:
        most: pixels, see `most_pixels`; of more a random part is taken.
        distance: [V, H, W] pixels to the silhouette, negative inside; infinite beyond a picture.
        doubted: [V, H, W] bool, where rough masks are not believed: left out, here and, as if there
            were no object, wherever the photographs are looked at later. None: masks are right.
    """
    if doubted is not None:
        photos = photos.without(doubted)
    counts = [int(_near(distance, doubted, view).sum()) for view in range(len(photos))]
    draw = torch.Generator().manual_seed(0)
    if sum(counts) > most:
        share = most / sum(counts)
        counts = [round(share * count) for count in counts]
    with_colors = memmap.on_disk(photos.color)
    width = 3 + (packed_width(photos) if with_colors else 0)
    pixels = torch.empty(sum(counts), width, dtype=torch.int32)
    for view, part in enumerate(pixels.split(counts)):
        found = _near(distance, doubted, view).nonzero()
        if len(found) > len(part):
            found = found[torch.randperm(len(found), generator=draw)[: len(part)]]
        part[:, 0] = view
        part[:, 1:3] = found
        if with_colors:
            part[:, 3:] = packed(photos, view, found)
    order = torch.randperm(len(pixels), generator=torch.Generator().manual_seed(0))
    if doubted is not None:  # no pixel at an edge is held out while there are others
        at_edge = distance[pixels[:, :3].long().unbind(1)].abs() < EDGE
        order = order[at_edge[order].long().argsort(stable=True)]
    held = min(HELD_OUT, len(pixels) // 10)
    if not held:  # so few that none can be spared
        return TrainingPixels(photos, pixels, pixels)
    if with_colors:
        return TrainingPixels(photos, *_taken_out_(pixels, order[:held]))
    return TrainingPixels(photos, pixels[order[held:]], pixels[order[:held]])


def _taken_out_(pixels: Tensor, chosen: Tensor) -> tuple[Tensor, Tensor]:
    """Rows without the chosen ones [K], and these; in the memory of all, in another order."""
    taken, last = pixels[chosen], len(pixels) - len(chosen)
    stays = torch.ones(len(pixels), dtype=torch.bool)
    stays[chosen] = False
    pixels[chosen[chosen < last]] = pixels[last + stays[last:].nonzero()[:, 0]]
    return pixels[:last], taken


def _near(distance: Tensor, doubted: Tensor | None, view: int) -> Tensor:
    """Which pixels [H, W] of a view are looked at."""
    near = distance[view] < MARGIN
    return near if doubted is None else near & ~doubted[view]


# What a training will need, against what the machine leaves: said before the kernel says it.


# Bytes, as trainings on 13 to 133 million pixels, 0.25 to 4 million voxels, were seen to take
PER_PIXEL = 23  # distances, masks, orders, brightness, besides the photographs themselves
PER_DRAWN = 48  # of a pixel that is trained on, where the photographs lie on disk: its row, twice
PER_VOXEL = 100  # distances and features with gradients and moments, hulls, meshes
PER_RAY = 40_000  # of a step: samples and what is between them


def needed(photos: Photos, cfg: TrainConfig) -> int:
    """Bytes, about, that training takes besides the photographs, which are there already."""
    if memmap.on_disk(photos.color):
        return needed_for(0, cfg) + PER_DRAWN * most_pixels(cfg)
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
    # Pixels of the files that have to become one along a side, if that is enough
    pixels = PER_PIXEL * photos.alpha.numel()
    rest = left - (further - pixels)
    factor = math.ceil(photos.downscale * math.sqrt(pixels / rest)) if rest > 0 else None
    what = (
        f"training on {len(photos)} photographs of {photos.cameras.width}x{photos.cameras.height} "
        f"pixels needs about {(further + have) / 1e9:.1f} GB; {left / 1e9:.1f} of "
        f"{there.total / 1e9:.1f} GB are free"
    )
    change = f"downscale={factor}" if factor else "preset=draft"
    if further + have > there.total:
        raise UserError(f"{what}: pass {change}", "downscale", "preset")
    log.warning(
        "%s: if the system kills the training process, pass %s or close other programs",
        *(what, change),
        extra={"arguments": ("downscale", "preset")},
    )
