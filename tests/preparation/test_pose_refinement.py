"""Silhouettes and matched points that contradict cameras or masks; which of them is believed."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from analytic import RADIUS, cameras_around, cameras_at, photos_of, sphere_normals

from lab.stress.damage import turned
from univoxel.camera import PoseSteps, project
from univoxel.data import Photos
from univoxel.errors import UserError
from univoxel.preparation import matches as task
from univoxel.preparation import pose_refinement
from univoxel.preparation.hull import mask_distances
from univoxel.preparation.matches import (
    Agreement,
    Matches,
    agreement,
    epipolar_distances,
    find_matches,
    neighbours,
)
from univoxel.preparation.pose_refinement import (
    Edges,
    align_,
    choose_masks_or_poses,
    contradiction,
    right,
)

VIEWS, SIZE = 16, 64
BOX = torch.full((3,), -0.7), torch.full((3,), 0.7)


def distances():
    """Of the sphere in 16 photographs; a degree is 1.2 pixels of them."""
    return mask_distances(photos_of(VIEWS, SIZE).alpha)


def turned_cameras(degrees, seed=0):
    return turned(cameras_around(VIEWS, SIZE), degrees, np.random.default_rng(seed))


def off(cameras):
    """Pixels [V] that the sphere's centre is off by."""
    truth = cameras_around(VIEWS, SIZE)
    middle = torch.zeros(1, 3)
    pairs = [project(cameras, v, middle)[0] - project(truth, v, middle)[0] for v in range(VIEWS)]
    return torch.cat(pairs).norm(dim=1)


def aligned(cameras):
    poses = PoseSteps(VIEWS)
    poses.about(cameras, torch.zeros(3), 0.7)
    align_(poses, distances(), cameras, BOX)
    return poses.eval().corrected(cameras)


def test_true_cameras_do_not_contradict_and_stay():
    # Their edge pixels lie 0.5 to 1.6 pixels inside; masks without soft borders are off by half one
    assert contradiction(distances(), cameras_around(VIEWS, SIZE), BOX) < -0.1
    assert off(aligned(cameras_around(VIEWS, SIZE))).mean() < 0.15


@pytest.mark.parametrize("degrees", [1.0, 3.0])
def test_turned_cameras_contradict_and_are_moved_until_they_agree(degrees):
    """By about what they are off."""
    cameras = turned_cameras(degrees)
    assert 0.5 < contradiction(distances(), cameras, BOX) / off(cameras).mean() < 4.0
    found = aligned(cameras)
    assert contradiction(distances(), found, BOX) < 0.1
    assert off(found).mean() < 0.3 * off(cameras).mean()


def test_a_view_says_nothing_of_what_lies_beyond_its_picture():
    """A camera that sees a corner of the object contradicts no other."""
    cameras, distance = cameras_around(VIEWS, SIZE), distances()
    cut = torch.full_like(distance[3], 20.0)
    cut[:, : SIZE // 2] = distance[3][:, SIZE // 2 :]  # the left half is out of the picture
    centre = cameras.centre.clone()
    centre[3, 0] -= SIZE // 2
    distance[3] = torch.where(torch.arange(SIZE) < SIZE // 2, cut, 20.0)
    assert contradiction(distance, replace(cameras, centre=centre), BOX) < -0.1


def test_places_that_no_picture_shows_are_no_part_of_the_object():
    """In a box far too large rays go on behind the one camera that they are held against."""
    edges = Edges(distances(), (6 * BOX[0], 6 * BOX[1]))
    pixels = edges.sample(200, torch.Generator().manual_seed(0))
    missed = edges.missed(cameras_around(VIEWS, SIZE), pixels, torch.tensor([0]))
    assert missed.quantile(0.95) < 0.1


def test_without_silhouettes_nothing_is_said_and_nothing_moves():
    cameras, empty = cameras_around(VIEWS, SIZE), torch.full((VIEWS, SIZE, SIZE), 64.0)
    assert contradiction(empty, cameras, BOX) == 0.0
    poses = PoseSteps(VIEWS)
    align_(poses, empty, cameras, BOX)
    assert not poses.steps.any()


MATCHED, WIDTH = 8, 200


@pytest.fixture(scope="module", autouse=True)
def few():
    """Few pairs, for time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(task, "PAIRS", 8)
        patch.setattr(task, "MIN_MATCHES", 40)
        yield


def cameras_on_a_ring(views=MATCHED, size=WIDTH):
    """Cameras 15 degrees apart, two units from the origin."""
    phi = torch.arange(views) * math.radians(15)
    places = torch.stack([2 * phi.cos(), 2 * phi.sin(), torch.full_like(phi, 0.6)], 1)
    return cameras_at(places, size, 1.3 * size)


def painted(points):
    """Colours [N, 3] of a ball: the sum of waves in random directions."""
    random = np.random.default_rng(0)
    wave = torch.from_numpy(random.standard_normal((40, 3)) * 25).float()
    phase = torch.from_numpy(random.uniform(0, 6.28, 40)).float()
    value = torch.sin(points @ wave.T + phase).sum(1) / 6
    return (0.5 + 0.3 * value).clamp(0.02, 1)[:, None].expand(-1, 3)


def photographs(paint=painted):
    """Of a ball, in linear float32."""
    cameras = cameras_on_a_ring()
    colors, alphas = [], []
    for view in range(len(cameras)):
        normal, hit = sphere_normals(cameras, view)
        colors.append(paint(RADIUS * normal.view(-1, 3)).view(WIDTH, WIDTH, 3) * hit[..., None])
        alphas.append(hit.float())
    names = [f"r_{v}" for v in range(len(cameras))]
    return Photos(Path("ball"), names, torch.stack(colors), torch.stack(alphas), cameras)


@pytest.fixture(scope="module")
def photos():
    return photographs()


@pytest.fixture(scope="module")
def distance(photos):
    return mask_distances(photos.coverage())


@pytest.fixture(scope="module")
def matches(photos, distance):
    return find_matches(photos, distance)


def wrong(photos, degrees):
    return turned(photos.cameras, degrees, np.random.default_rng(0))


def test_projections_of_a_point_lie_on_each_others_lines():
    cameras = cameras_on_a_ring()
    points = 0.3 * torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    one, other = (project(cameras, v, points)[0] for v in (2, 4))
    views = torch.tensor([2, 4]).expand(50, 2)
    assert epipolar_distances(cameras, Matches(views, one, other)).max() < 1e-3  # float32 cameras
    # Cameras of one height: their lines are nearly level, and three pixels down are three away
    off = epipolar_distances(cameras, Matches(views, one, other + torch.tensor([0.0, 3.0])))
    assert off.median() == pytest.approx(3.0, rel=0.1)
    swapped = Matches(views.flip(1), other + torch.tensor([0.0, 3.0]), one)
    torch.testing.assert_close(epipolar_distances(cameras, swapped), off)


def test_true_cameras_are_believed_and_turned_ones_are_not(photos, matches):
    found = agreement(photos.cameras, matches)
    assert found.median < 0.4  # what keypoints are placed to
    assert found.matches == len(matches) >= task.MIN_MATCHES
    assert right(found, 5.0)
    before = found.median
    for degrees in (0.5, 1.0):
        off = agreement(wrong(photos, degrees), matches)
        assert off.median > before
        assert not right(off, 100.0)
        before = off.median


def test_matches_are_found_by_other_cameras_as_well(photos, distance):
    """Cameras choose neighbours only: wrong ones choose no matches that suit them."""
    cameras = wrong(photos, 1.0)
    found = find_matches(replace(photos, cameras=cameras), distance)
    assert agreement(photos.cameras, found).median < 0.4
    assert not right(agreement(cameras, found), 100.0)


def test_cameras_are_to_blame_where_they_explain_the_contradiction():
    assert right(Agreement(0.3, 1.0, 100), 5.0)
    assert not right(Agreement(0.3, 1.0, 100), 1.0)
    assert not right(Agreement(2.0, 5.0, 100), 50.0)
    assert not right(None, 50.0)


def test_plain_objects_and_none_at_all_leave_it_undecided(distance, photos):
    plain = photographs(lambda points: torch.full_like(points, 0.5))
    assert agreement(plain.cameras, find_matches(plain, distance)) is None
    empty = torch.full((MATCHED, WIDTH, WIDTH), 99.0)
    assert len(find_matches(photos, empty)) == 0


def test_neighbours_see_the_object_from_near(monkeypatch):
    monkeypatch.setattr(task, "PAIRS", 5)
    cameras = cameras_on_a_ring()
    for one, other in neighbours(cameras):
        assert other - one == 1  # 15 degrees apart
    assert neighbours(cameras_on_a_ring(1)) == []


def bitten(photos):
    """Masks of which one lacks its upper half."""
    alpha = photos.alpha.clone()
    alpha[3, : WIDTH // 2] = 0
    return replace(photos, alpha=alpha), mask_distances(alpha)


def test_a_mask_that_lacks_a_part_is_outvoted_unless_it_is_given(photos, caplog):
    spoilt, distance = bitten(photos)
    with caplog.at_level("INFO"):
        found = choose_masks_or_poses(spoilt, distance, "auto", "auto")
    assert (found.refined, found.votes) == (False, 2)
    assert "the masks are assumed to be rough" in caplog.text
    assert found.box[1][2] > 0.9 * RADIUS  # nothing is bitten off
    found = choose_masks_or_poses(spoilt, distance, "auto", "given")
    assert (found.refined, found.votes) == (False, 1)
    assert found.box[1][2] < 0.5 * RADIUS


def test_cameras_that_photographs_contradict_are_refined(photos, distance, caplog):
    off = replace(photos, cameras=wrong(photos, 1.0))
    with caplog.at_level("INFO"):
        found = choose_masks_or_poses(off, distance, "auto", "auto")
    assert (found.refined, found.votes) == (True, 1)
    assert "pixels: camera poses are refined" in caplog.text
    assert not choose_masks_or_poses(off, distance, "given", "auto").refined


def test_silhouettes_that_agree_are_not_asked_twice(photos, distance, monkeypatch):
    monkeypatch.setattr(
        pose_refinement, "find_matches", lambda *_: pytest.fail("nobody doubts anything")
    )
    found = choose_masks_or_poses(photos, distance, "auto", "auto")
    assert (found.refined, found.votes) == (False, 1)
    assert choose_masks_or_poses(photos, distance, "refined", "auto").refined


def test_one_empty_place_in_masks_is_outvoted_or_refused(photos):
    """A mask of another object: nothing lies in all silhouettes."""
    alpha = photos.alpha.clone()
    alpha[3] = 0
    alpha[3, :8, :8] = 1
    spoilt, distance = replace(photos, alpha=alpha), mask_distances(alpha)
    found = choose_masks_or_poses(spoilt, distance, "auto", "auto")
    assert found.votes == 2
    assert found.box[1].min() > 0.9 * RADIUS
    with pytest.raises(UserError, match="have no common volume"):
        choose_masks_or_poses(spoilt, distance, "auto", "given")
