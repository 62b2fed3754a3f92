"""Which pixels of the photographs training looks at."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from univoxel.data import Photos

MARGIN = 6.0  # pixels around the silhouettes that are trained on; farther ones are empty
HELD_OUT = 2048  # pixels of the training photographs that are only looked at, to follow quality


@dataclass(frozen=True)
class TrainingPixels:
    """Photographs, and which of their pixels [P, 3] int32 (view, row, column) serve what."""

    photos: Photos
    trained: Tensor
    held_out: Tensor  # only looked at, to follow quality


def split_pixels(photos: Photos, distance: Tensor, doubted: Tensor | None = None) -> TrainingPixels:
    """The pixels in or near silhouettes: those to train on, and some that are held out.

    Args:
        distance: [V, H, W] pixels to the silhouette, negative inside; infinite beyond a picture.
        doubted: [V, H, W] bool, where masks are not believed: left out, here and, as if there were
            no object, wherever the photographs are looked at later.
    """
    if doubted is not None:
        photos = replace(photos, alpha=photos.alpha.masked_fill(doubted, 0))
    near = distance < MARGIN
    pixels = _nonzero(near if doubted is None else near & ~doubted)
    order = torch.randperm(len(pixels), generator=torch.Generator().manual_seed(0))
    held = min(HELD_OUT, len(pixels) // 10)
    if not held:  # so few that none can be spared
        return TrainingPixels(photos, pixels, pixels)
    return TrainingPixels(photos, pixels[order[held:]], pixels[order[:held]])


def _nonzero(there: Tensor) -> Tensor:
    """The same as of torch, [P, 3] of a tensor [V, H, W], in half of the memory."""
    counts = there.sum((1, 2)).tolist()
    pixels = torch.empty(sum(counts), 3, dtype=torch.int32)
    for view, part in enumerate(pixels.split(counts)):
        part[:, 0] = view
        part[:, 1:] = there[view].nonzero()
    return pixels
