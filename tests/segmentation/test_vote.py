"""Masks that vote, and a network that keeps the table or loses a part."""

import pytest
import torch
from analytic import cameras_around
from spoilt_masks import BESIDE, MISSING, iou, kept_table, lost_part, true_mask

from univoxel.camera import image_rays
from univoxel.errors import UserError
from univoxel.grid import GridShape
from univoxel.segmentation import vote
from univoxel.segmentation.vote import VoteConfig

VIEWS, SIZE = 40, 64
SMALL = VoteConfig(voxels=48, first_voxels=24)


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
    return cameras, true, masks, faults, *vote.elect(masks, cameras, SMALL)


def test_the_vote_tells_and_mends_what_is_wrong(fake):
    cameras, true, masks, faults, hull, largest = fake
    before = torch.tensor([iou(m, t) for m, t in zip(masks, true, strict=True)])
    assert before.mean() < 0.85  # or there is nothing to mend
    wrong = before < 0.9
    found = [
        vote.judge(hull, mask, cameras, view, largest[view], SMALL)
        for view, mask in enumerate(masks)
    ]
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
            assert torch.equal(verdict.mask, mask)  # what is right stays, bit by bit


def test_votes_without_those_that_elect(fake):
    """A photograph that did not vote is judged by the same hull."""
    cameras, true, _, _, hull, largest = fake
    right = vote.judge(hull, true[0], cameras, 0, None, SMALL)
    empty = vote.judge(hull, torch.zeros(SIZE, SIZE), cameras, 0, largest[0], SMALL)
    assert right.fault == ""
    assert empty.fault == MISSING
    assert empty.agreement == 0
    assert iou(empty.mask, true[0]) > 0.9


def test_masks_that_contradict_one_another_are_wrong_in_their_majority():
    """Each shows another place: no hull explains half of them."""
    cameras = cameras_around(16, 64)
    masks = []
    for view in range(16):
        mask = torch.zeros(64, 64)
        row, column = 12 * (view % 4), 12 * (view // 4)
        mask[row : row + 20, column : column + 20] = 1
        masks.append(mask)
    hull, largest = vote.elect(masks, cameras, SMALL)
    found = [vote.judge(hull, m, cameras, v, largest[v], SMALL).fault for v, m in enumerate(masks)]
    assert sum(map(bool, found)) > 8


def test_masks_that_show_nothing():
    cameras = cameras_around(12, 32)
    with pytest.raises(UserError, match="nothing in common"):
        vote.elect([torch.zeros(32, 32)] * 12, cameras, SMALL)
    with pytest.raises(UserError, match="too faint or too few"):
        vote.elect([torch.full((32, 32), 0.1)] * 12, cameras, SMALL)


def test_votes_are_means_of_those_that_see_a_node():
    cameras = cameras_around(12, 32)
    grid = GridShape((-0.1, -0.1, -0.1), 0.1, (3, 3, 3))
    masks = [torch.full((32, 32), float(view < 3)) for view in range(12)]
    torch.testing.assert_close(vote.votes(masks, cameras, grid), torch.full((3, 3, 3), 0.25))
    far = GridShape((50.0, 0.0, 0.0), 0.1, (2, 2, 2))  # beside most pictures
    assert not vote.votes(masks, cameras, far).any()


def test_the_largest_vote_along_a_ray():
    """One node alone: what rays come near to it."""
    cameras = cameras_around(2, 64)
    node = torch.tensor([0.1, -0.2, 0.3])
    grid = GridShape(tuple((node - 0.4).tolist()), 0.1, (9, 9, 9))
    single = torch.zeros(9, 9, 9)
    single[4, 4, 4] = 1.0
    largest = vote.largest_votes(grid, single, cameras, 1, (64, 64)).flatten()
    rays = image_rays(cameras, 1)
    away = torch.linalg.cross(node - rays.origin, rays.direction).norm(dim=1)
    assert not largest[away > 0.1 * 3**0.5].any()  # a voxel's diagonal
    assert (largest[away < 0.02] > 0.5).all()
    assert (away < 0.02).any()


def test_overlaps_at_each_level():
    largest = torch.tensor([[0.0, 0.2, 0.5, 0.9]])
    mask = torch.tensor([[0.0, 1.0, 1.0, 0.0]])
    found = vote.overlaps(largest, mask, torch.tensor([0.1, 0.3, 0.6, 0.95]))
    torch.testing.assert_close(found, torch.tensor([2 / 3, 1 / 3, 0.0, 0.0]))
    nothing = vote.overlaps(largest, torch.zeros(1, 4), torch.tensor([0.95]))
    assert nothing.tolist() == [1.0]


@pytest.mark.parametrize(
    ("field", "value"),
    [("pixels", 4), ("voxels", 2), ("first_voxels", 3)],
)
def test_fields_out_of_range(field, value):
    with pytest.raises(ValueError, match=f"VoteConfig: {field} must be"):
        VoteConfig(**{field: value})


def test_what_cameras_look_at_is_a_cube():
    lower, upper = vote.surroundings(cameras_around(16, 40))
    torch.testing.assert_close(lower, -upper, atol=1e-4, rtol=0)
    assert 0.8 < float(upper[0]) < 0.9  # a sphere of 0.8 is seen whole, at distance 2
