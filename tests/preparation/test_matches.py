"""Points matched between photographs, and which of cameras and masks they make believed."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from analytic import RADIUS, look_at

from lab.stress.damage import turned
from univoxel.camera import Cameras, image_rays, project
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
from univoxel.preparation.pose_refinement import choose_masks_or_poses, right

VIEWS, SIZE = 8, 200


@pytest.fixture(scope="module", autouse=True)
def few():
    """Few pairs, for time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(task, "PAIRS", 8)
        patch.setattr(task, "MIN_MATCHES", 40)
        yield


def cameras_on_a_ring(views=VIEWS, size=SIZE):
    """Cameras 15 degrees apart, two units from the origin."""
    poses = []
    for v in range(views):
        phi = math.radians(15 * v)
        poses.append(look_at(torch.tensor([2 * math.cos(phi), 2 * math.sin(phi), 0.6])))
    focal = torch.full((views, 2), size * 1.3)
    return Cameras(torch.stack(poses), focal, torch.full((views, 2), size / 2), size, size)


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
        rays = image_rays(cameras, view)
        b = (rays.origin * rays.direction).sum(1)
        root = b.square() - rays.origin.square().sum(1) + RADIUS**2
        hit = root > 0
        points = rays.origin + (-b - root.clamp_min(0).sqrt())[:, None] * rays.direction
        colors.append(torch.where(hit[:, None], paint(points), 0.0).reshape(SIZE, SIZE, 3))
        alphas.append(hit.reshape(SIZE, SIZE).float())
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


def test_plain_objects_leave_it_undecided(distance):
    plain = photographs(lambda points: torch.full_like(points, 0.5))
    assert agreement(plain.cameras, find_matches(plain, distance)) is None


def test_photographs_without_an_object_have_no_matches(photos):
    empty = torch.full((VIEWS, SIZE, SIZE), 99.0)
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
    alpha[3, : SIZE // 2] = 0
    return replace(photos, alpha=alpha), mask_distances(alpha)


def test_a_mask_that_lacks_a_part_is_outvoted_and_cameras_stay(photos, caplog):
    spoilt, distance = bitten(photos)
    with caplog.at_level("INFO"):
        found = choose_masks_or_poses(spoilt, distance, "auto", "auto")
    assert (found.refined, found.votes) == (False, 2)
    assert "the masks are assumed to be rough" in caplog.text
    assert found.box[1][2] > 0.9 * RADIUS  # nothing is bitten off


def test_masks_as_given_are_not_doubted(photos):
    spoilt, distance = bitten(photos)
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
