"""Depth maps of a textured room whose distances are known."""

import pytest
import textured_room
import torch

from univoxel.camera import image_rays
from univoxel.data.photos import Photos
from univoxel.preparation import stereo

VIEWS, WIDTH, HEIGHT = 24, 160, 120


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    views = textured_room.orbit(VIEWS, WIDTH, HEIGHT)
    return textured_room.photos_of(views, tmp_path_factory.mktemp("room"))


@pytest.fixture(scope="module")
def maps(room):
    return stereo.depth_maps(room)


def true_distance(room, view):
    """Of what a view's pixels show: [H, W]."""
    seen = textured_room.orbit(VIEWS, WIDTH, HEIGHT)[view]
    return torch.from_numpy(textured_room.distance(seen))


def test_depth_is_that_of_the_room(room, maps):
    errors, known = [], []
    for view in range(0, VIEWS, 4):
        true = true_distance(room, view)
        errors.append(((maps.distance[view] - true).abs() / maps.step)[maps.known[view]])
        known.append(maps.known[view][room.alpha[view] > 200].float().mean())
    errors = torch.cat(errors)
    assert errors.quantile(0.5) < 0.5
    assert (errors < 2).float().mean() > 0.9
    assert torch.stack(known).mean() > 0.7


def test_exposure_takes_no_part(room):
    picture = room.color[0].float() / 255
    one, other = (stereo.comparable(gain * picture).float() for gain in (1.0, 0.5))
    assert (one - other).abs().quantile(0.9) < 10  # of 255; the darkest parts differ by more


def test_what_has_no_texture_is_not_known(room, maps):
    """A wall of one colour matches at any depth: neighbours then agree by chance only."""
    plain = Photos(
        room.folder, room.names, torch.full_like(room.color, 127), room.alpha, room.cameras
    )
    found = stereo.depth_maps(plain)
    true = torch.stack([true_distance(room, view) for view in range(0, VIEWS, 8)])
    near = (found.distance[::8] - true).abs() < 2 * found.step
    assert (near & found.known[::8]).float().mean() < 0.5 * maps.known[::8].float().mean()


def test_views_are_compared_with_those_beside_them(room):
    compared = stereo.views_to_compare(room.cameras)
    for view, others in enumerate(compared):
        assert 0 < len(others) <= stereo.NEIGHBORS
        assert view not in others.tolist()
    place = room.cameras.camera_to_world[:, :, 3]
    assert (place[compared[0]] - place[0]).norm(dim=1).max() < (place - place[0]).norm(dim=1).max()


def test_lone_cameras_compare_with_nothing(room):
    far = room.cameras.of(torch.tensor([0, VIEWS // 2]))
    assert [len(others) for others in stereo.views_to_compare(far)] == [0, 0]


def test_least_costs_between_steps():
    cost = torch.tensor([[4.0, 1.0, 0.0, 1.0, 4.0], [9.0, 2.25, 0.25, 0.25, 2.25]])
    torch.testing.assert_close(stereo.lowest(cost), torch.tensor([2.0, 2.5]))


def test_pixels_of_points(room):
    rays = image_rays(room.cameras, 3)
    points = rays.origin + 2.0 * rays.direction
    row, column, seen = stereo.pixels_of(room.cameras, 3, points)
    assert seen.all()
    assert torch.equal(row * WIDTH + column, torch.arange(WIDTH * HEIGHT))
    assert not stereo.pixels_of(room.cameras, 3, rays.origin - rays.direction)[2].any()
