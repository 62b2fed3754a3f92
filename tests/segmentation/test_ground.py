"""Objects on a patterned floor in a furnished room, found as what hides the floor."""

import math
from dataclasses import replace

import numpy as np
import pytest
import textured_room
import torch
from spoilt_masks import iou
from torch import Tensor

from univoxel.camera import Cameras
from univoxel.segmentation import ground as task
from univoxel.segmentation.ground import Ground, Plane, find_ground, ground_mask, warped

VIEWS, WIDTH, HEIGHT = 24, 200, 150
# A pattern of this size asks for no more places, and few heights are far from the right one


@pytest.fixture(scope="module", autouse=True)
def small():
    """Less of everything, for time."""
    with pytest.MonkeyPatch.context() as patch:
        for name, less in {"SIDE": 320, "HEIGHTS": 31, "TRIALS": 40, "VIEWS": 24}.items():
            patch.setattr(task, name, less)
        yield


@pytest.fixture(scope="module")
def room() -> tuple[list[Tensor], list[Tensor], Cameras]:
    """Photographs, the object's true masks, and cameras."""
    views = textured_room.orbit(VIEWS, WIDTH, HEIGHT)
    made = [textured_room.photograph(view) for view in views]
    photographs = [torch.from_numpy(np.array(picture)) for picture, _ in made]
    masks = [torch.from_numpy(np.array(mask)).float() / 255 for _, mask in made]
    return photographs, masks, textured_room.cameras(views)


@pytest.fixture(scope="module")
def ground(room) -> Ground:
    photographs, _, cameras = room
    found = find_ground(photographs, cameras)
    assert found is not None
    return found


def test_the_plane_is_where_the_floor_is(ground):
    plane = ground.floor.plane
    # A pixel is 0.011 units wide at the object
    assert abs(plane.height) < 0.003
    assert max(map(abs, plane.slope)) < 0.003
    assert float(ground.floor.known.mean()) > 0.4  # the rest is far off or under the object


def test_masks_are_those_of_the_object(room, ground):
    photographs, true, cameras = room
    overlaps = [
        iou(ground_mask(ground, one, cameras, v), true[v]) for v, one in enumerate(photographs)
    ]
    # A border of one pixel in 200 is 4 % of the object
    assert min(overlaps) > 0.9
    assert sum(overlaps) / VIEWS > 0.93


def test_a_world_that_leans_is_found_as_well(room):
    photographs, true, cameras = room
    c, s = math.cos(0.05), math.sin(0.05)
    turn = torch.tensor([[1.0, 0, 0], [0, c, -s], [0, s, c]])
    leaning = replace(cameras, camera_to_world=turn @ cameras.camera_to_world)
    found = find_ground(photographs, leaning)
    assert found is not None
    assert found.floor.plane.slope == pytest.approx((0, math.tan(0.05)), abs=0.004)
    assert iou(ground_mask(found, photographs[0], leaning, 0), true[0]) > 0.9


def test_photographs_of_other_sizes_are_masked_in_their_own(ground):
    view = textured_room.orbit(VIEWS, 2 * WIDTH, 2 * HEIGHT)[3]
    picture, mask = textured_room.photograph(view, samples=1)
    found = ground_mask(
        ground, torch.from_numpy(np.array(picture)), textured_room.cameras([view]), 0
    )
    assert found.shape == (2 * HEIGHT, 2 * WIDTH)
    assert iou(found, torch.from_numpy(np.array(mask)).float() / 255) > 0.9


def test_an_object_of_one_colour_is_no_floor(room):
    """It has its colour at any height, and so in the plane, too."""
    photographs, true, cameras = room
    red = torch.tensor([200, 60, 40]).byte()
    painted = [
        torch.where(mask[..., None] > 0.5, red, one)
        for one, mask in zip(photographs, true, strict=True)
    ]
    found = find_ground(painted, cameras)
    assert found is not None
    overlaps = [iou(ground_mask(found, painted[v], cameras, v), true[v]) for v in (0, 9)]
    assert min(overlaps) > 0.9


@pytest.mark.parametrize(
    ("rule", "strict"), [("CLEARLY", 0.01), ("AGREE", 0.01), ("OVERLAP", 0.999)]
)
def test_a_plane_on_which_photographs_agree_too_little_is_none(room, rule, strict, monkeypatch):
    photographs, _, cameras = room
    monkeypatch.setattr(task, rule, strict)
    assert find_ground(photographs, cameras) is None


def test_a_background_that_stands_still_is_no_ground():
    """On a turntable no plane agrees."""
    view = textured_room.orbit(VIEWS, WIDTH, HEIGHT)[0]
    made = [
        textured_room.photograph(view, 1, turn=2 * math.pi * v / VIEWS, still=True)[0]
        for v in range(VIEWS)
    ]
    photographs = [torch.from_numpy(np.array(picture)) for picture in made]
    around = textured_room.cameras(textured_room.orbit(VIEWS, WIDTH, HEIGHT))
    assert find_ground(photographs, around) is None


def test_a_floor_of_one_colour_says_nothing(room):
    _, masks, cameras = room
    plain = [
        torch.where(mask[..., None] > 0.5, torch.tensor([200, 60, 40]), 128).byte()
        for mask in masks
    ]
    assert find_ground(plain, cameras) is None


def test_a_floor_with_nothing_on_it_holds_no_object(room):
    """Where the mask is, the floor goes on."""
    _, _, cameras = room
    photographs = []
    for view in textured_room.orbit(VIEWS, WIDTH, HEIGHT):
        y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        scale = view.focal * WIDTH
        local = np.stack([(x - WIDTH / 2) / scale, (HEIGHT / 2 - y) / scale, -np.ones_like(x)])
        direction = view.pose[:, :3] @ local.reshape(3, -1)
        away = -view.pose[2, 3] / np.minimum(direction[2], -1e-3)
        color = textured_room.noise(view.pose[:, 3:] + away * direction)
        picture = (255 * color).round().astype(np.uint8).reshape(HEIGHT, WIDTH, 3)
        photographs.append(torch.from_numpy(picture))
    assert find_ground(photographs, cameras) is None


def test_rays_meet_a_leaning_plane_on_it():
    plane = Plane(torch.tensor([0.5, -0.2]), 0.3, (0.1, -0.05))
    points = plane.points(torch.tensor([-1.0, 0.0, 2.0]))
    origin = torch.tensor([[0.1, 0.2, 3.0]]).expand(9, 3)
    place, meets = plane.met(origin, points - origin)
    assert bool(meets.all())
    torch.testing.assert_close(place, points[:, :2] - plane.middle)
    assert not bool(plane.met(origin, origin - points)[1].any())


def test_all_of_the_plane_is_in_its_picture():
    place = torch.tensor([[0.0, 0.0], [2.0, -2.0], [1e6, -1e6]])
    torch.testing.assert_close(
        warped(place, 2.0), torch.tensor([[0, 0], [0.5, -0.5], [1.0, -1.0]]), atol=1e-5, rtol=0
    )
