"""Correction of inconsistent masks with the shape that photographs and masks agree on.

Where a mask and the object's silhouette differ by more than a jagged edge, nothing is known: the
pixel tells neither of the object nor of emptiness.

A part may have moved when the object was turned over, such as a lid or a limb. Then photographs of
each position of the object agree with one another, but not with those of another position. The
model has the part where the position with the most photographs shows it. The others tell nothing of
that place, and nothing of where they show the part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import ndimage
from skimage.measure import label
from torch import Tensor
from torch.nn.functional import interpolate

from univoxel.camera import Cameras, image_rays, stacked
from univoxel.core import log, memmap
from univoxel.core.memmap import parallel_map
from univoxel.data import Photos
from univoxel.data.photos import coverage_of
from univoxel.errors import UserError
from univoxel.fields.distances import DenseDistances
from univoxel.fields.grid import GridShape, fit_grid, resample
from univoxel.lights.views import positions_of
from univoxel.ops import VisibilityScene
from univoxel.preparation.hull import (
    estimate_bounds,
    mask_distances,
    visual_hull,
    votes_needed,
)
from univoxel.preparation.object_shape import (
    ObjectShape,
    find_object,
    largest_part,
    shrunk,
    silhouettes,
)
from univoxel.preparation.pose_refinement import MAX_CONTRADICTION, Belief, contradiction
from univoxel.preparation.stereo import DepthMaps, depth_maps, pixels_of

# Half the width, in pixels of the depth maps, of what a mask lacks or shows too much before it is
# doubted: narrower pieces are its jagged edge
JAGGED = 2.0
# Voxels along a side of the grid, on average, on which parts that moved are looked for
VOXELS = 96
# Share of a position's photographs whose masks show a place beyond the hull that it shares with the
# largest position: somewhere in a part that moved, and everywhere in it
CORE, WHOLE = 0.2, 0.05
# Voxels around these places: most of such a part lies in the hulls of both positions
NEAR = 4
# Share of the object that a part is at least and at most: where cameras are wrong, more moves
LEAST_PART, MOST_PART = 0.001, 0.2


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
    moved = undo_moves_(masks, maps, belief.box)
    shape, shown = best_object(masks, maps)
    pixels = memmap.zeros(photos.alpha.shape, torch.bool)

    def doubt_(view: int) -> None:
        doubted = thick((masks[view] >= 0.5) != shown[view]) | moved[view]
        own = cameras.cut(view, pixels[view])
        own.copy_(interpolate(doubted[None, None].float(), own.shape)[0, 0] > 0)

    parallel_map(doubt_, range(len(photos)))
    fill_(distance, photos, pixels)
    box = estimate_bounds(distance, cameras, belief.votes)
    off = contradiction(distance, cameras, box, pixels)
    told = "the other masks (depth is not used, because the shape fits the masks better without it)"
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


def undo_moves_(masks: list[Tensor], maps: DepthMaps, box: tuple[Tensor, Tensor]) -> list[Tensor]:
    """Where photographs show a part elsewhere than the largest position: V times [h, w] bool.

    Changes `masks` there to show the part in its place, and `maps.known` to False.

    Args:
        masks: V, [h, w] in [0, 1] of the sizes of the depth maps.
        box: corners [3], [3] around the object.
    """
    cameras, moved = maps.cameras, [torch.zeros_like(mask, dtype=torch.bool) for mask in masks]
    positions = sorted(positions_of(cameras), key=len, reverse=True)
    if len(positions) < 2:
        return moved
    grid, distance = fit_grid(*box, VOXELS**3), mask_distances(stacked(masks), cameras)
    hulls = [visual_hull(distance[p], cameras.of(p), grid, votes_needed(len(p))) for p in positions]
    for hull, position in zip(hulls[1:], positions[1:], strict=True):
        shared = torch.maximum(hulls[0], hull)
        if not shared.min() < 0 < shared.max():
            continue
        shown = silhouettes(ObjectShape(grid, -shared, 0.0), cameras)
        beyond = [thick((mask >= 0.5) & ~one) for mask, one in zip(masks, shown, strict=True)]
        stays = part_beyond(beyond, cameras, positions[0], grid, (hulls[0] < 0) & (hull >= 0))
        moves = part_beyond(beyond, cameras, position, grid, (hull < 0) & (hulls[0] >= 0))
        sizes = [int(part.sum()) / int((shared < 0).sum()) for part in (stays, moves)]
        log.debug("parts beyond the hull of both positions: %.4f and %.4f of it", *sizes)
        if not all(LEAST_PART < size < MOST_PART for size in sizes):
            continue
        log.info(
            "a part moved when the object was turned over: %d of %d photographs show it elsewhere "
            "and are ignored there",
            *(len(position), len(masks)),
        )
        whole = torch.where(stays, -grid.voxel_size, shared)
        joined = torch.where(moves, -grid.voxel_size, whole)
        both = VisibilityScene(*DenseDistances(grid, joined).isosurface())
        near = torch.from_numpy(ndimage.binary_dilation((stays | moves).numpy(), iterations=NEAR))
        shown = list(silhouettes(ObjectShape(grid, -whole, 0.0), cameras))
        for view in position.tolist():
            rays = image_rays(cameras, view)
            t = both.closest_hit(rays.origin, rays.direction).t
            met = t.isfinite().nonzero()[:, 0]
            place = rays.origin[met] + t[met, None] * rays.direction[met]
            x, y, z = ((place - grid.bounds()[0]) / grid.voxel_size).round().long().unbind(1)
            there = beyond[view].clone()
            there.view(-1)[met] |= near[x, y, z]
            moved[view] |= there
            masks[view] = torch.where(there, shown[view].float(), masks[view])
            cameras.cut(view, maps.known[view])[there] = False
    return moved


def part_beyond(
    beyond: Sequence[Tensor], cameras: Cameras, views: Tensor, grid: GridShape, among: Tensor
) -> Tensor:
    """The connected nodes [X, Y, Z] bool that some views [N] show beyond a hull.

    Args:
        beyond: V, [h, w] bool, what masks show there.
        among: [X, Y, Z] bool, nodes that may be.
    """
    index = among.flatten().nonzero()[:, 0]
    nodes, count = grid.nodes().view(-1, 3)[index], torch.zeros(len(index))
    for view in views.tolist():
        row, column, seen = pixels_of(cameras, view, nodes)
        count += seen & beyond[view][row, column]
    share = torch.zeros(grid.size)
    share.view(-1)[index] = count / len(views)
    parts = torch.from_numpy(np.asarray(label((share >= WHOLE).numpy(), connectivity=1)))
    return torch.isin(parts, parts[share >= CORE].unique())


def best_object(masks: Sequence[Tensor], maps: DepthMaps) -> tuple[ObjectShape, list[Tensor]]:
    """The object as masks alone show it, or what depth leaves of that, whichever fits the masks
    [H, W] better, jagged edges aside; and its silhouettes [h, w] bool.

    Depth tells of hollows, and of what most masks show too much. But in a mirror it is that of the
    reflection: then the object's silhouettes lose what all masks show.
    """
    by_masks = find_object(masks, replace(maps, known=torch.zeros_like(maps.known)))
    try:
        by_depth = find_object(masks, maps)
    except UserError:  # depth of reflections may leave nothing
        return by_masks, list(silhouettes(by_masks, maps.cameras))
    by_masks_here = resample(by_masks.inside, by_masks.grid, by_depth.grid)
    both = replace(by_depth, inside=largest_part(torch.minimum(by_depth.inside, by_masks_here)))
    found = []
    for shape in (both, by_masks) if (both.inside > 0).any() else (by_masks,):
        shown = list(silhouettes(shape, maps.cameras))
        differs = [thick((m >= 0.5) != one) for m, one in zip(masks, shown, strict=True)]
        found.append((shape, shown, sum(int(one.sum()) for one in differs)))
    return min(found, key=lambda one: one[2])[:2]


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
