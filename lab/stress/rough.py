"""Masks as people draw them: jagged, wrong here and there, cut off, each ending elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy import ndimage

from univoxel.data import Photos

SPOILT = 0.1  # share of the masks without a part or with a piece of the ground, at 1 %
SHIFTED = 0.1  # share of the photographs whose edge cuts the object, at 1 %
CUT = 0.15  # share of the object's width that lies beyond the picture then
ENDS = 0.03  # share of the object's height by which masks end too early, at most, at 1 %
PART = 0.25  # radius of what is missing, shares of the object's larger side
DEPTH = 0.3  # radius of what is kept of the ground, the same


def shifted(photos: Photos, percent: float, random: np.random.Generator) -> Photos:
    """Photographs of which some are taken beside the object: their edge cuts it.

    What a shifted picture shows again is empty.
    """
    color, alpha, centre = photos.color.clone(), photos.alpha.clone(), photos.cameras.centre.clone()
    for view in _some(len(photos), SHIFTED * percent, random):
        columns = (alpha[view] > 0).any(0).nonzero()[:, 0]
        low, high, width = int(columns.min()), int(columns.max()) + 1, alpha.shape[2]
        cut = round(CUT * (high - low))
        by = -(low + cut) if random.uniform() < 0.5 else width - high + cut
        for stored in (color, alpha):
            moved = torch.roll(stored[view], by, 1)
            empty = slice(width + by, width) if by < 0 else slice(0, by)
            moved[:, empty] = 0
            stored[view] = moved
        centre[view, 0] += by
    cameras = replace(photos.cameras, centre=centre)
    return replace(photos, color=color, alpha=alpha, cameras=cameras)


def rough_masks(alpha: np.ndarray, percent: float, random: np.random.Generator) -> np.ndarray:
    """Masks [V, H, W] of 0 and 1 as people draw them, from coverage.

    Args:
        percent: of the picture, by which the jagged edge deviates; all else grows with it.
    """
    wrong = _some(len(alpha), SPOILT * percent, random)
    masks = np.stack([_drawn(a, percent, random) for a in alpha])
    for k, view in enumerate(wrong):
        masks[view] = (_without_a_part if k % 2 == 0 else _with_ground)(masks[view], random)
    return masks.astype(np.float32)


def _some(views: int, share: float, random: np.random.Generator) -> np.ndarray:
    return random.permutation(views)[: round(min(share, 1.0) * views)]


def _drawn(alpha: np.ndarray, percent: float, random: np.random.Generator) -> np.ndarray:
    """One mask with a jagged edge, that ends too early."""
    inside = alpha >= 0.5
    outside, depth = (ndimage.distance_transform_edt(m) for m in (~inside, inside))
    deviation = percent / 100 * max(alpha.shape)
    noise = ndimage.gaussian_filter(random.standard_normal(alpha.shape), max(1.0, 2 * deviation))
    noise *= deviation / max(noise.std(), 1e-12)
    mask = np.asarray(outside) - np.asarray(depth) + noise < 0
    rows = np.flatnonzero(inside.any(1))
    if len(rows):
        end = random.uniform(0, ENDS * percent) * (rows[-1] + 1 - rows[0])
        mask[round(rows[-1] + 1 - end) :] = False
    return mask


def _without_a_part(mask: np.ndarray, random: np.random.Generator) -> np.ndarray:
    place = np.argwhere(mask & ~np.asarray(ndimage.binary_erosion(mask), bool))
    return mask & ~_disc(mask, place[random.integers(len(place))], PART)


def _with_ground(mask: np.ndarray, random: np.random.Generator) -> np.ndarray:
    rows, columns = mask.nonzero()
    place = np.array([rows.max(), random.uniform(columns.min(), columns.max())])
    return mask | _disc(mask, place, DEPTH)


def _disc(mask: np.ndarray, middle: np.ndarray, radius: float) -> np.ndarray:
    """A disc, of a radius in shares of the larger side of what the mask shows."""
    larger = max(np.ptp(x) + 1 for x in mask.nonzero())
    y, x = np.mgrid[: mask.shape[0], : mask.shape[1]]
    return np.hypot(y - middle[0], x - middle[1]) < radius * larger
