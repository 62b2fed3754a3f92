"""Silhouettes that contradict one another, and cameras that are moved until they agree."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic import cameras_around, photos_of

from lab.stress.damage import turned
from univoxel.camera import PoseSteps, project
from univoxel.preparation.hull import mask_distances
from univoxel.preparation.pose_refinement import Edges, align_, contradiction

VIEWS, SIZE = 16, 64
BOX = torch.full((3,), -0.7), torch.full((3,), 0.7)


def distances():
    """Of the sphere in 16 photographs; a degree is 1.2 pixels of them."""
    return mask_distances(photos_of(VIEWS, SIZE).alpha)


def wrong(degrees, seed=0):
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


def test_true_cameras_do_not_contradict():
    # Their edge pixels lie 0.5 to 1.6 pixels inside; masks without soft borders are off by half one
    assert contradiction(distances(), cameras_around(VIEWS, SIZE), BOX) < -0.1


@pytest.mark.parametrize("degrees", [1.0, 3.0])
def test_turned_cameras_contradict_by_about_what_they_are_off(degrees):
    cameras = wrong(degrees)
    found = contradiction(distances(), cameras, BOX)
    assert 0.5 < found / off(cameras).mean() < 4.0


@pytest.mark.parametrize("degrees", [1.0, 3.0])
def test_turned_cameras_are_moved_until_they_agree(degrees):
    cameras = wrong(degrees)
    found = aligned(cameras)
    assert contradiction(distances(), found, BOX) < 0.1
    assert off(found).mean() < 0.3 * off(cameras).mean()


def test_true_cameras_stay():
    assert off(aligned(cameras_around(VIEWS, SIZE))).mean() < 0.15


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
