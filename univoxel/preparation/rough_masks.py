"""Correction of inconsistent masks with the shape that photographs and masks agree on.

Where a mask and the object's silhouette differ by more than a jagged edge, nothing is known: the
pixel tells neither of the object nor of emptiness. A part that was moved between photographs, such
as a lid, is doubted in those that disagree with the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor
from torch.nn.functional import interpolate

from univoxel.camera import Cameras
from univoxel.core import log, memmap
from univoxel.core.memmap import parallel_map
from univoxel.data import Photos
from univoxel.data.photos import coverage_of
from univoxel.preparation.hull import estimate_bounds, mask_distances
from univoxel.preparation.object_shape import ObjectShape, find_object, shrunk, silhouettes
from univoxel.preparation.pose_refinement import MAX_CONTRADICTION, Belief, contradiction
from univoxel.preparation.stereo import DepthMaps, depth_maps

# Half the width, in pixels of the depth maps, of what a mask lacks or shows too much before it is
# doubted: narrower pieces are its jagged edge
JAGGED = 2.0
# How many times as many pixels of the masks as without depth an object may contradict with it. Of
# a tankard, whose depth is right, it was 1.1, of five scenes in which it made silhouettes worse 1.3
# to 3.2
CLEARLY = 1.2


@dataclass(frozen=True)
class Doubted:
    """What is made of rough masks."""

    shape: ObjectShape  # that photographs and masks agree on
    pixels: Tensor  # [V, H, W] bool: nothing is known there
    belief: Belief  # one vote, where what is not doubted agrees


def doubt_masks(photos: Photos, distance: Tensor, belief: Belief) -> Doubted:
    """Which pixels of rough masks are not to be believed.

    Args:
        distance: [V, H, W] from `hull.mask_distances`; it becomes that of masks with all that is
            doubted.
        belief: of more than one vote.

    Raises:
        UserError: the masks have nothing in common, or silhouettes share no volume.
    """
    cameras, maps = photos.cameras, depth_maps(photos)
    masks = parallel_map(lambda view: small_mask(photos, view, maps.cameras), range(len(photos)))
    shape, shown = best_object(masks, maps)
    pixels = memmap.zeros(photos.alpha.shape, torch.bool)

    def doubt_(view: int) -> None:
        doubted = thick((masks[view] >= 0.5) != shown[view])
        own = cameras.cut(view, pixels[view])
        own.copy_(interpolate(doubted[None, None].float(), own.shape)[0, 0] > 0)

    parallel_map(doubt_, range(len(photos)))
    fill_(distance, photos, pixels)
    box = estimate_bounds(distance, cameras, belief.votes)
    off = contradiction(distance, cameras, box, pixels)
    told = "the other masks (depth is ignored, because it disagrees with most masks)"
    if shape.surface:
        told = "the other masks and the depth, which is known for "
        told += f"{shape.surface:.0%} of the surface"
    log.info(
        "%.1f%% of the pixels are uncertain, because a mask differs from %s",
        *(100 * float(pixels.float().mean()), told),
    )
    votes = 1 if off <= MAX_CONTRADICTION else belief.votes
    if votes != belief.votes:
        box = estimate_bounds(distance, cameras, votes)
    return Doubted(shape, pixels, replace(belief, box=box, votes=votes, off=off))


def best_object(masks: Sequence[Tensor], maps: DepthMaps) -> tuple[ObjectShape, list[Tensor]]:
    """The object with its depth or as masks alone show it, whichever fits the masks [H, W] better;
    and its silhouettes [h, w] bool.

    Depth tells of hollows, and of what most masks lack or show too much. But in a mirror it is that
    of the reflection: then the object's silhouettes lose what all masks show.
    """
    found = []
    for known in (maps.known, torch.zeros_like(maps.known)):
        shape = find_object(masks, replace(maps, known=known))
        shown = list(silhouettes(shape, maps.cameras))
        differs = [(mask >= 0.5) != one for mask, one in zip(masks, shown, strict=True)]
        found.append((shape, shown, sum(int(one.sum()) for one in differs)))
    (with_depth, without) = found
    best = with_depth if with_depth[2] <= CLEARLY * without[2] else without
    return best[:2]


def thick(differs: Tensor) -> Tensor:
    """The pieces [H, W] bool of a difference that are wider than a jagged edge."""
    inner = np.asarray(ndimage.distance_transform_edt(np.pad(differs.numpy(), 1)))[1:-1, 1:-1]
    deep = inner > JAGGED
    if not deep.any():
        return torch.zeros_like(differs)
    near = np.asarray(ndimage.distance_transform_edt(~deep)) <= JAGGED + 1
    return differs & torch.from_numpy(near)


def small_mask(photos: Photos, view: int, cameras: Cameras) -> Tensor:
    """The mask of a photograph in the size of smaller cameras: [h, w] in [0, 1]."""
    return shrunk(coverage_of(photos.stored(view)[1]), *cameras.size(view))


def fill_(distance: Tensor, photos: Photos, doubted: Tensor) -> None:
    """Make `mask_distances` [V, H, W] those of masks with all that is doubted: a view carves
    nothing there."""
    full = 1 if photos.alpha.is_floating_point() else 255

    def one(view: int) -> None:
        alpha = photos.alpha[view].masked_fill(doubted[view], full)
        distance[view] = mask_distances(alpha[None], photos.cameras.of(torch.tensor([view])))[0]

    parallel_map(one, doubted.flatten(1).any(1).nonzero()[:, 0].tolist())
