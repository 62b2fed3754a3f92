"""Depth maps of a textured room whose distances are known."""

from dataclasses import replace

import textured_room
import torch

from univoxel.camera import image_rays
from univoxel.preparation import stereo


def true_distance(room, view):
    """Of what a view's pixels show: [H, W]."""
    cameras = room[0].cameras
    seen = textured_room.orbit(len(cameras), cameras.width, cameras.height)[view]
    return torch.from_numpy(textured_room.distance(seen))


def test_depth_is_that_of_the_room(room):
    photos, maps = room
    errors, known = [], []
    for view in range(0, len(photos), 4):
        true = true_distance(room, view)
        errors.append(((maps.distance[view] - true).abs() / maps.step)[maps.known[view]])
        known.append(maps.known[view][photos.alpha[view] > 200].float().mean())
    errors = torch.cat(errors)
    assert errors.quantile(0.5) < 0.5
    assert (errors < 2).float().mean() > 0.9
    assert torch.stack(known).mean() > 0.7


def test_exposure_takes_no_part(room):
    picture = room[0].color[0].float() / 255
    one, other = (stereo.comparable(gain * picture).float() for gain in (1.0, 0.5))
    assert (one - other).abs().quantile(0.9) < 10  # of 255; the darkest parts differ by more


def test_what_has_no_texture_is_not_known(room):
    """A wall of one colour matches at any depth: neighbours then agree by chance only."""
    photos, maps = room
    found = stereo.depth_maps(replace(photos, color=torch.full_like(photos.color, 127)))
    true = torch.stack([true_distance(room, view) for view in range(0, len(photos), 8)])
    near = (found.distance[::8] - true).abs() < 2 * found.step
    assert (near & found.known[::8]).float().mean() < 0.5 * maps.known[::8].float().mean()


def test_views_are_compared_with_those_beside_them(room):
    cameras = room[0].cameras
    compared = stereo.views_to_compare(cameras)
    for view, others in enumerate(compared):
        assert 0 < len(others) <= stereo.NEIGHBORS
        assert view not in others.tolist()
    place = cameras.camera_to_world[:, :, 3]
    assert (place[compared[0]] - place[0]).norm(dim=1).max() < (place - place[0]).norm(dim=1).max()
    far = cameras.of(torch.tensor([0, len(cameras) // 2]))
    assert [len(others) for others in stereo.views_to_compare(far)] == [0, 0]


def test_least_costs_between_steps():
    cost = torch.tensor([[4.0, 1.0, 0.0, 1.0, 4.0], [9.0, 2.25, 0.25, 0.25, 2.25]])
    torch.testing.assert_close(stereo.lowest(cost), torch.tensor([2.0, 2.5]))


def test_pixels_of_points(room):
    cameras = room[0].cameras
    rays = image_rays(cameras, 3)
    row, column, seen = stereo.pixels_of(cameras, 3, rays.origin + 2.0 * rays.direction)
    assert seen.all()
    assert torch.equal(row * cameras.width + column, torch.arange(len(row)))
    assert not stereo.pixels_of(cameras, 3, rays.origin - rays.direction)[2].any()
