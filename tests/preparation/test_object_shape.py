"""The object told in 3D by masks and depth: faults of masks, boxes, gaps that few see through."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic import cameras_around, cameras_at
from spoilt_masks import BESIDE, MISSING, iou, kept_table, lost_part, true_mask, without_depth

from univoxel.camera import Cameras, image_rays
from univoxel.capture.masks import grown, judge, voxel_pixels
from univoxel.errors import UserError
from univoxel.fields.grid import GridShape, fit_grid
from univoxel.preparation import object_shape
from univoxel.preparation.object_shape import (
    ObjectShape,
    box_corners,
    find_object,
    share_of,
    silhouettes,
    votes,
)
from univoxel.preparation.rough_masks import best_object
from univoxel.preparation.stereo import pixels_of

VIEWS, SIZE, VOXELS = 40, 64, 48
AROUND = (-0.5, -0.5, 0.03, 0.6, 0.5, 1.2)  # the object in the room


@pytest.fixture(scope="module")
def fake():
    """Masks of a network that keeps the table in 45 % of them and loses a part in 5 %."""
    cameras = cameras_around(VIEWS, SIZE)
    true = [true_mask(cameras, view) for view in range(VIEWS)]
    order = torch.randperm(VIEWS, generator=torch.Generator().manual_seed(3)).tolist()
    masks, faults = list(true), [""] * VIEWS
    for view in order[:18]:
        masks[view], faults[view] = kept_table(cameras, view), BESIDE
    for view in order[18:20]:
        masks[view], faults[view] = lost_part(true[view]), MISSING
    shape = find_object(masks, without_depth(cameras), VOXELS)
    return cameras, true, masks, faults, shape, list(silhouettes(shape, cameras))


def test_masks_outvote_those_that_are_wrong(fake):
    cameras, true, masks, faults, shape, shown = fake
    before = torch.tensor([iou(m, t) for m, t in zip(masks, true, strict=True)])
    assert before.mean() < 0.85  # or there is nothing to repair
    usual = float(np.median([iou(m, s) for m, s in zip(masks, shown, strict=True)]))
    found = [
        judge(mask, shown[view], usual, voxel_pixels(shape.grid, cameras, view))
        for view, mask in enumerate(masks)
    ]
    wrong = before < 0.9
    flagged = torch.tensor([bool(verdict.fault) for verdict in found])
    assert (flagged & wrong).sum() >= 0.9 * flagged.sum()  # precision
    assert (flagged & wrong).sum() >= 0.9 * wrong.sum()  # recall
    after = torch.tensor([iou(v.mask, t) for v, t in zip(found, true, strict=True)])
    assert after.mean() >= 0.97
    assert after.min() >= 0.85  # an edge that is seen flat spoils little, and stays
    for verdict, fault, mask in zip(found, faults, masks, strict=True):
        if verdict.fault:
            assert verdict.fault == fault
        else:
            assert torch.equal(verdict.mask, mask)  # what is right stays, bit for bit


def test_boxes_that_are_none_or_hold_nothing():
    for values in ((0, 0, 0, 1, 1), (0, 0, 0, 1, 1, 0), (0, 0, 0, 1, 1, math.nan)):
        with pytest.raises(
            UserError, match=r"box: expected X0 Y0 Z0 X1 Y1 Z1 with .*, got 0 0 0 1 1"
        ):
            box_corners(values)
    cameras = cameras_around(12, 32)
    masks, box = [true_mask(cameras, v) for v in range(12)], box_corners((1, 1, 1, 1.2, 1.2, 1.2))
    with pytest.raises(UserError, match=r"around the object, got 1 1 1 .*cameras look at"):
        find_object(masks, without_depth(cameras), VOXELS, box)


def test_pixels_that_see_a_box():
    cameras = cameras_around(6, 40)
    box = box_corners((-0.3, -0.3, -0.3, 0.3, 0.3, 0.3))
    for view in range(6):
        shown = object_shape.box_shown(cameras, view, box)
        grid = fit_grid(box[0], box[1], 24**3)
        inside = grid.nodes()[object_shape.depth_in(grid, box) >= 0]
        row, column, _ = pixels_of(cameras, view, inside)
        assert grown(shown)[row, column].all()
        assert shown.sum() < 1.15 * len(set(zip(row.tolist(), column.tolist(), strict=True)))
    around = box_corners((-3, -3, -3, 3, 3, 3))
    assert object_shape.box_shown(cameras, 0, around).all()  # from inside


def test_masks_that_show_too_little():
    cameras = cameras_around(12, 32)
    with pytest.raises(UserError, match="do not overlap anywhere"):
        find_object([torch.zeros(32, 32)] * 12, without_depth(cameras), VOXELS)
    masks = [0.2 * torch.ones(32, 32)] * 12
    with pytest.raises(UserError, match="too faint"):
        find_object(masks, without_depth(cameras), VOXELS)


@pytest.mark.parametrize("spoilt", ["none", "lost", "whole picture"])
def test_depth_and_masks_find_the_object(room, spoilt):
    """One mask in five lacks a part, or shows all of the picture."""
    photos, maps = room
    masks = list(photos.coverage())
    given = list(masks)
    for view in range(0, len(masks), 5):
        if spoilt == "lost":
            given[view] = lost_part(masks[view])
        if spoilt == "whole picture":
            given[view] = torch.ones_like(masks[view])
    shape = find_object(given, maps, 64)
    agree = [iou(s, m) for s, m in zip(silhouettes(shape, photos.cameras), masks, strict=True)]
    assert np.mean(agree) > 0.95
    assert min(agree) > 0.9
    assert shape.surface > 0.7


def test_depth_that_contradicts_the_masks_is_not_believed(room):
    """As of a mirror: depth lies behind the object's surface."""
    photos, maps = room
    masks = list(photos.coverage())
    object_ = torch.stack([m >= 0.5 for m in masks])
    behind, far = (replace(maps, distance=maps.distance + x * object_) for x in (0.8, 100.0))
    for known, asked in ((maps, True), (behind, False), (far, False)):
        shape, shown = best_object(masks, known)
        assert (shape.surface > 0) == asked
        agree = [iou(s, m) for s, m in zip(shown, masks, strict=True)]
        assert np.mean(agree) > 0.95


def test_depth_empties_the_air_that_masks_keep(room):
    """All masks show the whole picture; around the object's head there is only air."""
    photos, maps = room
    masks = list(photos.coverage())
    everything = [torch.ones_like(mask) for mask in masks]
    for known, least, most in ((maps, 0.0, 0.05), (without_depth(photos.cameras), 0.9, 1.0)):
        shape = find_object(everything, known, 64)
        nodes = shape.grid.nodes()
        away, height = nodes[..., :2].norm(dim=-1), nodes[..., 2]
        air = (away > 0.65) & (away < 0.9) & (height > 0.4) & (height < 1.0)
        assert air.any()
        assert least <= float((shape.inside[air] > 0).float().mean()) <= most


def test_a_box_ends_what_all_masks_keep(room):
    photos, maps = room
    masks = list(photos.coverage())
    everything, box = [torch.ones_like(mask) for mask in masks], box_corners(AROUND)
    shape = find_object(everything, maps, 64, box)
    agree = [iou(s, m) for s, m in zip(silhouettes(shape, photos.cameras), masks, strict=True)]
    assert np.mean(agree) > 0.9
    lower, upper = object_shape.inside_bounds(shape)
    assert (lower >= box[0]).all()
    assert (upper <= box[1]).all()


def test_a_hidden_place_is_not_asked():
    """A view from which a known surface hides a node has no vote on whose it is."""
    cameras = cameras_around(8, 32)
    grid = GridShape((-0.1, -0.1, -0.1), 0.1, (3, 3, 3))
    maps = without_depth(cameras)
    maps.distance[:4], maps.known[:4] = 1.0, True  # of 2 to the middle
    maps.distance[4:6], maps.known[4:6] = 3.0, True
    found = object_shape.votes([torch.ones(32, 32)] * 8, maps, grid)
    assert (found.seen == 8).all()
    assert (found.open == 4).all()
    assert (found.free == 2).all()
    assert (found.near == 0).all()


def test_the_largest_part_remains():
    inside = torch.full((8, 8, 8), -1.0)
    inside[1:4, 1:4, 1:4], inside[6, 6, 6] = 0.5, 0.5
    found = object_shape.largest_part(inside)
    assert (found > 0).sum() == 27
    assert found[6, 6, 6] < 0


def test_signed_distance_of_a_ball():
    grid = GridShape((-1.0, -1.0, -1.0), 0.1, (21, 21, 21))
    away = grid.nodes().norm(dim=-1)
    finer = GridShape((-0.9, -0.9, -0.9), 0.05, (37, 37, 37))
    found = object_shape.signed_distance(ObjectShape(grid, 0.6 - away, 1.0), finer)
    off = (found - (finer.nodes().norm(dim=-1) - 0.6)).abs()
    assert off.quantile(0.99) < 0.05


GATE_SIZE = 96
ABOVE, THROUGH = 24, 3  # cameras that look down on a gate, and that see through it
GATE_VOXELS, THRESHOLD = 48, 0.9
# Two posts on a plate: lower and upper corner of each
GATE = (
    ((-0.6, -0.6, -0.3), (0.6, 0.6, -0.2)),
    ((-0.5, -0.5, -0.2), (-0.3, 0.5, 0.3)),
    ((0.3, -0.5, -0.2), (0.5, 0.5, 0.3)),
)
LOST = 4  # the photograph from above whose mask may lose a part


def cameras() -> Cameras:
    """Most look down from all sides; the last look along the posts, from little above the plate."""
    around = [(2 * math.pi * v / ABOVE, 0.6) for v in range(ABOVE)]
    around += [(math.pi / 2 + 0.05 * v, 0.1) for v in range(THROUGH)]
    places = [
        (math.cos(a) * math.cos(up), math.sin(a) * math.cos(up), math.sin(up)) for a, up in around
    ]
    return cameras_at(2.5 * torch.tensor(places), GATE_SIZE, 0.9 * GATE_SIZE)


def gate(seen: Cameras, view: int) -> torch.Tensor:
    """The mask [H, W] of what a camera sees of the gate, 0 or 1."""
    rays = image_rays(seen, view)
    hit = torch.zeros(len(rays.origin), dtype=torch.bool)
    for box in GATE:
        lower, upper = map(torch.tensor, box)
        ends = torch.stack([(e - rays.origin) / rays.direction for e in (lower, upper)])
        hit |= ends.amin(0).amax(1) < ends.amax(0).amin(1)
    return hit.reshape(GATE_SIZE, GATE_SIZE).float()


@pytest.fixture(scope="module")
def true():
    seen = cameras()
    return seen, [gate(seen, view) for view in range(ABOVE + THROUGH)]


@pytest.mark.parametrize("spoilt", [False, True], ids=["right", "one lost a part"])
def test_what_few_see_through_is_no_object(true, spoilt):
    seen, masks = true
    masks = list(masks)
    if spoilt:
        masks[LOST] = lost_part(masks[LOST])
    shape = find_object(masks, without_depth(seen), GATE_VOXELS)
    shown = list(silhouettes(shape, seen))
    for view in range(ABOVE, ABOVE + THROUGH):
        assert iou(shown[view], masks[view]) > 0.8  # filled: below 0.63
        assert judge(masks[view], shown[view], 0.95, 1.0).fault == ""
    found = judge(masks[LOST], shown[LOST], 0.95, voxel_pixels(shape.grid, seen, LOST))
    assert found.fault == (MISSING if spoilt else "")
    assert iou(found.mask, true[1][LOST]) > 0.93


def test_a_gap_that_others_contradict_stays(true):
    """A part that a single mask lost is in the hull as it was."""
    seen, masks = true
    grid = find_object(masks, without_depth(seen), GATE_VOXELS).grid
    share = share_of(votes(masks, without_depth(seen), grid), len(masks))
    object_shape.carve_gaps_(share, THRESHOLD, masks, seen, grid)
    inside = share >= THRESHOLD
    spoilt = [lost_part(m) if v == LOST else m for v, m in enumerate(masks)]
    after = share.clone()
    object_shape.carve_gaps_(after, THRESHOLD, spoilt, seen, grid)
    assert ((after < THRESHOLD) & inside).sum() < 0.02 * inside.sum()
    # Where nearly all lose it, those that do not are outvoted
    spoilt = [m if v == LOST else lost_part(m) for v, m in enumerate(masks)]
    gone = object_shape.carve_gaps_(after, THRESHOLD, spoilt, seen, grid)
    assert gone > 0.1 * inside.sum()
