"""The object told by depth alone: planes behind it, and what stands before them."""

import numpy as np
import pytest
import textured_room
import torch
from spoilt_masks import iou, without_depth

from univoxel.camera import image_rays, looked_at
from univoxel.fields.grid import fit_grid
from univoxel.preparation.object_shape import ROOM, box_corners, shrunk
from univoxel.preparation.standing_object import (
    Plane,
    background_planes,
    fitted,
    masks_by_depth,
    middle_part,
    surface_nodes,
)
from univoxel.preparation.stereo import depth_maps, reach


@pytest.fixture(scope="module")
def room():
    """As elsewhere, in pictures so large that the edges of the masks count for less."""
    photos = textured_room.photos_of(textured_room.orbit(30, 200, 150))
    return photos, depth_maps(photos)


def test_masks_are_those_of_the_object(room):
    photos, maps = room
    found = masks_by_depth(maps)
    true = [shrunk(m, *maps.cameras.size(v)) for v, m in enumerate(photos.coverage())]
    agreed = [iou(one, other) for one, other in zip(found, true, strict=True)]
    assert np.mean(agreed) > 0.8  # ragged where no depth is known; the shape of them all is not


def seen_in(box, maps):
    """Which pixels of each small photograph see a surface in a box, by formula."""
    for view in textured_room.orbit(30, maps.cameras.width, maps.cameras.height):
        away = torch.from_numpy(textured_room.distance(view)).float()
        place = torch.from_numpy(view.pose[:, 3]).float() + away.reshape(-1, 1) * directions(view)
        yield ((place >= box[0]) & (place <= box[1])).all(1).view(away.shape).float()


def directions(view):
    cameras = textured_room.cameras([view])
    return image_rays(cameras, 0).direction


def test_in_a_box_all_surface_is_the_object(room):
    _, maps = room
    head = box_corners((-0.5, -0.5, 0.52, 0.6, 0.5, 1.2))
    found = masks_by_depth(maps, head)
    agreed = [iou(a, b) for a, b in zip(found, seen_in(head, maps), strict=True)]
    assert np.mean(agreed) > 0.75  # of the whole object it is 0.5


def test_a_box_leaves_the_table_out(room):
    photos, maps = room
    found = masks_by_depth(maps, box_corners((-0.6, -0.6, -0.1, 0.6, 0.6, 1.2)))
    true = [shrunk(m, *maps.cameras.size(v)) for v, m in enumerate(photos.coverage())]
    assert np.mean([iou(a, b) for a, b in zip(found, true, strict=True)]) > 0.8


def test_a_box_in_the_air_and_no_match_have_nothing(room):
    assert masks_by_depth(room[1], box_corners((0.9, 0.9, 0.6, 1.2, 1.2, 0.9))) is None
    assert masks_by_depth(without_depth(room[0].cameras)) is None


def test_the_plane_is_the_floor(room):
    _, maps = room
    centre, half = looked_at(maps.cameras), ROOM * reach(maps.cameras)
    grid = fit_grid(centre - half, centre + half, 64**3)
    surface = surface_nodes(maps, grid)
    planes = background_planes(maps, grid, surface)
    assert planes[0].normal[2] > 0.999
    assert abs(planes[0].offset) < maps.step
    part = grid.nodes()[middle_part(maps, grid, surface, planes)]
    assert part[:, 2].min() > 0
    assert part[:, :2].norm(dim=1).max() < 0.7  # neither furniture nor walls


def test_a_plane_through_points():
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0))
    points[:, 2] = 0.3 + 0.1 * points[:, 0]
    for up in (1.0, -1.0):
        plane = fitted(points, torch.tensor([0.0, 0.0, up]))
        assert plane.height(points).abs().max() < 1e-5
        assert plane.near(points, 0.1).all()
        assert up * plane.normal[2] > 0.9
    assert Plane(torch.tensor([0.0, 0.0, 1.0]), 1.0).height(torch.tensor([5.0, 5.0, 3.0])) == 2
