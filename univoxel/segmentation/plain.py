"""Objects before plain walls, on plain desks: what edges shut off from the border of the picture.

A plain surface changes slowly, its shadows too. What can be reached from the picture's border
without crossing an edge is no object, in whatever colour. Where that leaves too much, as before a
room with texture, there is nothing to be had here.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy import ndimage
from skimage.measure import label
from skimage.segmentation import watershed
from torch import Tensor

from univoxel.bars import track
from univoxel.camera import Cameras
from univoxel.errors import UserError
from univoxel.segmentation.config import VoteConfig
from univoxel.segmentation.vote import elect

# Pixels of blur, of the picture whose edges count; less finds noise
BLUR = 1.0
# Changes of colour, sRGB a pixel, that are edges: each is tried, and the one whose masks agree
# best is taken. Noise asks for more, an object like the wall for less
THRESHOLDS = (0.01, 0.02, 0.04)
# Pixels of what an edge covers: narrower lines are no object
WIDTH = 3.0
# Share of the picture's border that is plain at least
RIM = 0.7
# Share of the picture that is reached from there at least
AROUND = 0.2
# Share of the photographs for which both hold at least
SHARE = 0.75
# Share of the largest part's area; smaller ones are dropped
SMALLEST_PART = 0.02
# Median IoU with the hull from which on the masks are believed: on a plain desk and in a plain
# room it was .94 and more, on a street .91
AGREE = 0.93


ROUGH = VoteConfig(pixels=96, voxels=48, first_voxels=24)  # enough to compare thresholds


def plain_threshold(photographs: Sequence[Tensor], cameras: Cameras) -> float | None:
    """The threshold of edges whose masks agree best across photographs [H, W, 3] uint8.

    None where the surroundings are not plain: too few photographs have a mask, or masks disagree.
    """
    steep = [edges(one) for one in track(photographs, "looking for edges")]
    best, agreed = None, AGREE
    for threshold in THRESHOLDS:
        masks = plain_masks(steep, threshold)
        if masks is None:
            continue
        try:
            hull, _ = elect(masks, cameras, ROUGH)
        except UserError:  # nothing in common
            continue
        if hull.usual >= agreed:
            best, agreed = threshold, hull.usual
    return best


def plain_mask(photograph: Tensor, threshold: float) -> Tensor:
    """The mask [H, W] of a photograph, 0 or 1; empty where its surroundings are not plain."""
    found = shut_off(edges(photograph), threshold)
    return torch.zeros(photograph.shape[:2]) if found is None else found


def edges(photograph: Tensor) -> np.ndarray:
    """How fast colours of a photograph [H, W, 3] uint8 change, [H, W] in sRGB a pixel."""
    values = photograph.numpy().astype(np.float32) / 255
    steep = [ndimage.gaussian_gradient_magnitude(c, BLUR) for c in np.moveaxis(values, 2, 0)]
    return np.max(steep, axis=0)


def shut_off(steep: np.ndarray, threshold: float) -> Tensor | None:
    """A mask [H, W], 0 or 1, of what edges of at least the threshold shut off from the border.

    None where the border is not plain, or nothing is shut off.
    """
    parts = np.asarray(label(steep < threshold, connectivity=1))
    rim = np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]])
    if (rim > 0).mean() < RIM:
        return None
    around = np.isin(parts, np.unique(rim[rim > 0]))
    away = np.asarray(ndimage.distance_transform_edt(~around))
    inner = away > WIDTH
    if not inner.any() or around.mean() < AROUND:
        return None
    # Between both the border is where colours change fastest
    found = np.asarray(watershed(steep, np.where(around, 1, np.where(inner, 2, 0)))) == 2
    blobs = np.asarray(label(found))
    size = np.bincount(blobs[found], minlength=1)
    found &= (size >= SMALLEST_PART * size.max())[blobs]
    return torch.from_numpy(ndimage.binary_fill_holes(found)).float()


def plain_masks(steep: Sequence[np.ndarray], threshold: float) -> list[Tensor] | None:
    """Masks [H, W] of all photographs, empty where one has none; None where too many have none."""
    found = [shut_off(one, threshold) for one in steep]
    if sum(mask is not None for mask in found) < SHARE * len(found):
        return None
    return [
        torch.zeros(one.shape) if mask is None else mask
        for one, mask in zip(steep, found, strict=True)
    ]
