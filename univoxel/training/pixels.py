"""Which pixels of the photographs training looks at."""

from __future__ import annotations

import torch
from torch import Tensor

MARGIN = 6.0  # pixels around the silhouettes that are trained on; farther ones are empty
HELD_OUT = 2048  # pixels of the training photographs that are only looked at, to follow quality


def split_pixels(distance: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels [P, 3] (view, row, column) in or near silhouettes: to train on, and held out.

    Args:
        distance: [V, H, W] pixels to the silhouette, negative inside.
    """
    pixels = (distance < MARGIN).nonzero()
    order = torch.randperm(len(pixels), generator=torch.Generator().manual_seed(0))
    held = min(HELD_OUT, len(pixels) // 10)
    if not held:  # so few that none can be spared
        return pixels, pixels
    return pixels[order[held:]], pixels[order[:held]]
