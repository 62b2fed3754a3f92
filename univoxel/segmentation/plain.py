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
from univoxel.segmentation.config import PlainConfig, VoteConfig
from univoxel.segmentation.vote import elect

PLAIN = PlainConfig()
ROUGH = VoteConfig(pixels=96, voxels=48, first_voxels=24)  # enough to compare thresholds


def plain_threshold(
    photographs: Sequence[Tensor], cameras: Cameras, cfg: PlainConfig = PLAIN
) -> float | None:
    """The threshold of edges whose masks agree best across photographs [H, W, 3] uint8.

    None where the surroundings are not plain: too few photographs have a mask, or masks disagree.
    """
    steep = [edges(one, cfg) for one in track(photographs, "looking for edges")]
    best, agreed = None, cfg.agree
    for threshold in cfg.thresholds:
        masks = plain_masks(steep, threshold, cfg)
        if masks is None:
            continue
        try:
            hull, _ = elect(masks, cameras, ROUGH)
        except UserError:  # nothing in common
            continue
        if hull.usual >= agreed:
            best, agreed = threshold, hull.usual
    return best


def plain_mask(photograph: Tensor, threshold: float, cfg: PlainConfig = PLAIN) -> Tensor:
    """The mask [H, W] of a photograph, 0 or 1; empty where its surroundings are not plain."""
    found = shut_off(edges(photograph, cfg), threshold, cfg)
    return torch.zeros(photograph.shape[:2]) if found is None else found


def edges(photograph: Tensor, cfg: PlainConfig = PLAIN) -> np.ndarray:
    """How fast colours of a photograph [H, W, 3] uint8 change, [H, W] in sRGB a pixel."""
    values = photograph.numpy().astype(np.float32) / 255
    steep = [ndimage.gaussian_gradient_magnitude(c, cfg.blur) for c in np.moveaxis(values, 2, 0)]
    return np.max(steep, axis=0)


def shut_off(steep: np.ndarray, threshold: float, cfg: PlainConfig = PLAIN) -> Tensor | None:
    """A mask [H, W], 0 or 1, of what edges of at least the threshold shut off from the border.

    None where the border is not plain, or nothing is shut off.
    """
    parts = np.asarray(label(steep < threshold, connectivity=1))
    rim = np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]])
    if (rim > 0).mean() < cfg.rim:
        return None
    around = np.isin(parts, np.unique(rim[rim > 0]))
    away = np.asarray(ndimage.distance_transform_edt(~around))
    inner = away > cfg.width
    if not inner.any() or around.mean() < cfg.around:
        return None
    # Between both the border is where colours change fastest
    found = np.asarray(watershed(steep, np.where(around, 1, np.where(inner, 2, 0)))) == 2
    blobs = np.asarray(label(found))
    size = np.bincount(blobs[found], minlength=1)
    found &= (size >= cfg.smallest_part * size.max())[blobs]
    return torch.from_numpy(ndimage.binary_fill_holes(found)).float()


def plain_masks(
    steep: Sequence[np.ndarray], threshold: float, cfg: PlainConfig = PLAIN
) -> list[Tensor] | None:
    """Masks [H, W] of all photographs, empty where one has none; None where too many have none."""
    found = [shut_off(one, threshold, cfg) for one in steep]
    if sum(mask is not None for mask in found) < cfg.share * len(found):
        return None
    return [
        torch.zeros(one.shape) if mask is None else mask
        for one, mask in zip(steep, found, strict=True)
    ]
