"""Masks that contradict one another, held against the object that photographs and masks agree on.

Where a mask and the object's silhouette differ by more than a jagged edge, nothing is known: the
pixel tells neither of the object nor of emptiness. A part that was moved between photographs, such
as a lid, is doubted in those that disagree with the others.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor
from torch.nn.functional import interpolate

from univoxel.core import memmap
from univoxel.core.memmap import parallel_map
from univoxel.data import Photos
from univoxel.data.photos import coverage_of
from univoxel.preparation.hull import estimate_bounds, mask_distances
from univoxel.preparation.object_shape import ObjectShape, find_object, shrunk, silhouettes
from univoxel.preparation.pose_refinement import MAX_CONTRADICTION, Belief, contradiction
from univoxel.preparation.stereo import depth_maps

log: logging.Logger = logging.getLogger("univoxel")

# Half the width, in pixels of the depth maps, of what a mask lacks or shows too much before it is
# doubted: narrower pieces are its jagged edge
JAGGED = 2.0


@dataclass(frozen=True)
class Doubted:
    """What is made of rough masks."""

    shape: ObjectShape  # that photographs and masks agree on
    pixels: Tensor  # [V, H, W] bool: nothing is known there
    distance: Tensor  # [V, H, W] pixels to silhouettes that hold what is doubted, negative inside
    belief: Belief  # one vote, where what is not doubted agrees


def doubt_masks(photos: Photos, belief: Belief) -> Doubted:
    """Which pixels of rough masks are not to be believed.

    Args:
        belief: of more than one vote.

    Raises:
        UserError: the masks have nothing in common, or silhouettes share no volume.
    """
    cameras, maps = photos.cameras, depth_maps(photos)
    masks = [coverage_of(photos.stored(view)[1]) for view in range(len(photos))]
    shape = find_object(masks, maps)
    shown = list(silhouettes(shape, maps.cameras))
    pixels = memmap.zeros(photos.alpha.shape, torch.bool)

    def doubt_(view: int) -> None:
        mask = shrunk(masks[view], *maps.cameras.size(view)) >= 0.5
        doubted = thick(mask != shown[view])
        own = cameras.cut(view, pixels[view])
        own.copy_(interpolate(doubted[None, None].float(), own.shape)[0, 0] > 0)

    parallel_map(doubt_, range(len(photos)))
    distance = filled_distances(photos, pixels)
    box = estimate_bounds(distance, cameras, belief.votes)
    off = contradiction(distance, cameras, box, pixels)
    log.info(
        "%.1f%% of the pixels are doubted, where a mask differs from what the others and the "
        "depth of the photographs show; depth shows %.0f%% of the surface",
        *(100 * float(pixels.float().mean()), 100 * shape.surface),
    )
    votes = 1 if off <= MAX_CONTRADICTION else belief.votes
    if votes != belief.votes:
        box = estimate_bounds(distance, cameras, votes)
    return Doubted(shape, pixels, distance, replace(belief, box=box, votes=votes, off=off))


def thick(differs: Tensor) -> Tensor:
    """The pieces [H, W] bool of a difference that are wider than a jagged edge."""
    inner = np.asarray(ndimage.distance_transform_edt(np.pad(differs.numpy(), 1)))[1:-1, 1:-1]
    deep = inner > JAGGED
    if not deep.any():
        return torch.zeros_like(differs)
    near = np.asarray(ndimage.distance_transform_edt(~deep)) <= JAGGED + 1
    return differs & torch.from_numpy(near)


def filled_distances(photos: Photos, doubted: Tensor) -> Tensor:
    """`mask_distances` [V, H, W] of masks with all that is doubted: a view carves nothing there."""
    alpha = memmap.zeros(photos.alpha.shape, photos.alpha.dtype)
    full = 1 if alpha.is_floating_point() else 255
    for view in range(len(photos)):
        alpha[view] = photos.alpha[view].masked_fill(doubted[view], full)
    return mask_distances(alpha, photos.cameras)
