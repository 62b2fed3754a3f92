"""Rough masks, mended: some of their pixels are doubted, and edges of the others moved.

A doubted pixel tells neither of the object nor of emptiness. So masks that lack a part no longer
bite into the hull, and it tells better what else to doubt. What the rest still contradicts itself
by is how far edges are off: nothing where only single masks are wrong, and then no edge is moved.
Where moved edges contradict one another nearly as much, edges are not what is wrong, and stay.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from univoxel import memmap
from univoxel.camera import looked_at, pixel_width
from univoxel.data import Photos
from univoxel.data.base import coverage_of
from univoxel.grid import fit_grid
from univoxel.preparation.belief import Belief, doubted_pixels
from univoxel.preparation.depth_sweep import surface_depths
from univoxel.preparation.hull import NODES, estimate_bounds, mask_distances, visual_hull
from univoxel.preparation.masks import with_masks
from univoxel.preparation.outlines import drawn_again, shows_nothing_else
from univoxel.preparation.registration import MAX_CONTRADICTION, contradiction

log: logging.Logger = logging.getLogger("univoxel")

# How many times as far edges are moved at most as what is not doubted of the masks contradicts
# itself by: of one edge in twenty that is more
FURTHER = 2.0
# Pixels by which they may be moved at least
LEAST = 2.0
# Share of what masks contradicted one another by that has to be left at most once edges are moved;
# of more, something else is wrong, and the edges go back. Jagged masks of the stress suite keep
# less than 0.3, those of a real head kept 0.9
KEPT = 0.5


@dataclass(frozen=True)
class Mended:
    """What is made of rough masks."""

    photos: Photos  # edges are moved to where colours change, if they are off
    doubted: Tensor  # [V, H, W] bool: nothing is known there
    distance: Tensor  # [V, H, W] pixels to silhouettes that hold what is doubted, negative inside
    belief: Belief  # one vote, where what is not doubted agrees


def mended(photos: Photos, distance: Tensor, belief: Belief) -> Mended:
    """Masks that contradict one another, as far as they can be believed.

    Args:
        distance: [V, H, W] from `hull.mask_distances`.
        belief: of more than one vote.

    Raises:
        UserError: the silhouettes share no volume.
    """
    doubted = doubted_pixels(distance, photos.cameras, belief)
    found = _doubted_again(photos, distance, doubted, belief)
    doubted = found.doubted
    if _agree(found):
        return _with_votes(found, 1)
    off = found.belief.off
    reach = max(FURTHER * off, LEAST)
    coverage = drawn_again(photos, distance, reach, doubted)
    photos, distance = with_masks(photos, lambda view: coverage[view])
    found, given = _doubted_again(photos, distance, doubted, belief), found
    if found.belief.off > KEPT * off:
        log.info(
            "edges of masks stay: moved to where colours change, they contradict one another by "
            "%.1f pixels, as given by %.1f",
            *(found.belief.off, off),
        )
        return _with_votes(given, belief.votes if given.doubted.any() else 1)
    found = _with_votes(found, 1 if _agree(found) else belief.votes)
    return _drawn_from_hull(found, reach, belief)


def _doubted_again(photos: Photos, distance: Tensor, doubted: Tensor, belief: Belief) -> Mended:
    """What is doubted by the hull of what was not."""
    cameras = photos.cameras
    filled = _filled(photos, distance, doubted)
    box = estimate_bounds(filled, cameras, belief.votes)
    doubted = doubted_pixels(distance, cameras, replace(belief, box=box), filled)
    filled = _filled(photos, distance, doubted)
    off = contradiction(filled, cameras, box, doubted)
    return Mended(photos, doubted, filled, replace(belief, box=box, off=off))


def _drawn_from_hull(found: Mended, reach: float, belief: Belief) -> Mended:
    """Edges once more, from where most masks have them: single ones waver, each in its own way.

    A hull that is coarser than what edges are off by tells nothing new.
    """
    photos, cameras = found.photos, found.photos.cameras
    grid = fit_grid(*found.belief.box, round(NODES))
    if grid.voxel_size > reach * pixel_width(cameras, looked_at(cameras)):
        return found
    hull = visual_hull(found.distance, cameras, grid, found.belief.votes)
    depths = surface_depths(hull, grid, cameras)

    def silhouette(view: int) -> Tensor:
        depth = next(depths)
        if shows_nothing_else(photos, found.distance, view):
            return coverage_of(photos.alpha[view])
        return depth.isfinite().float()

    usual, distance = with_masks(photos, silhouette)
    coverage = drawn_again(usual, distance, reach, found.doubted)
    photos, distance = with_masks(photos, lambda view: coverage[view])
    again = _doubted_again(photos, distance, found.doubted, belief)
    doubted = again.doubted | found.doubted
    filled = _filled(photos, distance, doubted)
    again = replace(again, doubted=doubted, distance=filled)
    return _with_votes(again, 1 if _agree(again) else belief.votes)


def _agree(found: Mended) -> bool:
    return found.belief.off <= MAX_CONTRADICTION


def _with_votes(found: Mended, votes: int) -> Mended:
    box = estimate_bounds(found.distance, found.photos.cameras, votes)
    return replace(found, belief=replace(found.belief, box=box, votes=votes))


def _filled(photos: Photos, distance: Tensor, doubted: Tensor) -> Tensor:
    """`mask_distances` [V, H, W] of masks with all that is doubted: a view carves nothing there."""
    views = doubted.flatten(1).any(1).nonzero()[:, 0]
    if not len(views):
        return distance
    coverage = torch.stack([coverage_of(photos.alpha[v]).masked_fill(doubted[v], 1) for v in views])
    changed = mask_distances(coverage, photos.cameras.of(views))
    result = memmap.zeros(distance.shape, distance.dtype)
    for view in range(len(distance)):
        result[view] = distance[view]
    for view, one in zip(views.tolist(), changed, strict=True):
        result[view] = one
    return result
