"""Gaps that few masks see through, and masks that lost what others show."""

import math

import pytest
import torch
from analytic import look_at
from spoilt_masks import MISSING, iou, lost_part, without_depth

from univoxel.camera import Cameras, image_rays
from univoxel.capture.masks import judge, voxel_pixels
from univoxel.preparation import object_shape
from univoxel.preparation.object_shape import find_object, share_of, silhouettes, votes

SIZE = 96
ABOVE, BESIDE = 24, 3  # cameras that look down on a gate, and that see through it
VOXELS, THRESHOLD = 48, 0.9
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
    around += [(math.pi / 2 + 0.05 * v, 0.1) for v in range(BESIDE)]
    places = [
        (math.cos(a) * math.cos(up), math.sin(a) * math.cos(up), math.sin(up)) for a, up in around
    ]
    poses = [look_at(2.5 * torch.tensor(place)) for place in places]
    count = len(poses)
    half = torch.full((count, 2), SIZE / 2)
    return Cameras(torch.stack(poses), torch.full((count, 2), 0.9 * SIZE), half, SIZE, SIZE)


def gate(seen: Cameras, view: int) -> torch.Tensor:
    """The mask [H, W] of what a camera sees of the gate, 0 or 1."""
    rays = image_rays(seen, view)
    hit = torch.zeros(len(rays.origin), dtype=torch.bool)
    for box in GATE:
        lower, upper = map(torch.tensor, box)
        ends = torch.stack([(e - rays.origin) / rays.direction for e in (lower, upper)])
        hit |= ends.amin(0).amax(1) < ends.amax(0).amin(1)
    return hit.reshape(SIZE, SIZE).float()


@pytest.fixture(scope="module")
def true():
    seen = cameras()
    return seen, [gate(seen, view) for view in range(ABOVE + BESIDE)]


@pytest.mark.parametrize("spoilt", [False, True], ids=["right", "one lost a part"])
def test_what_few_see_through_is_no_object(true, spoilt):
    seen, masks = true
    masks = list(masks)
    if spoilt:
        masks[LOST] = lost_part(masks[LOST])
    shape = find_object(masks, without_depth(seen), VOXELS)
    shown = list(silhouettes(shape, seen))
    for view in range(ABOVE, ABOVE + BESIDE):
        assert iou(shown[view], masks[view]) > 0.8  # filled: below 0.63
        assert judge(masks[view], shown[view], 0.95, 1.0).fault == ""
    found = judge(masks[LOST], shown[LOST], 0.95, voxel_pixels(shape.grid, seen, LOST))
    assert found.fault == (MISSING if spoilt else "")
    assert iou(found.mask, true[1][LOST]) > 0.93


def test_a_gap_that_others_contradict_stays(true):
    """A part that a single mask lost is in the hull as it was."""
    seen, masks = true
    grid = find_object(masks, without_depth(seen), VOXELS).grid
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
