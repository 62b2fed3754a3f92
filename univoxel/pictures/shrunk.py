"""Photographs as small as what stands beside them."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from univoxel.data import Photos


def shrunk(photos: Photos, view: int, width: int, height: int) -> Tensor:
    """A photograph by areas: [height, width, 4] linear, premultiplied."""
    color, alpha = photos.picture(view)
    stored = torch.cat([color * alpha[..., None], alpha[..., None]], -1).movedim(-1, 0)
    return interpolate(stored[None], (height, width), mode="area")[0].movedim(0, -1)
