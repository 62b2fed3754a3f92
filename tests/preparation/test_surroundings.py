"""What stands around an object, as a still and as a moving camera see it."""

from pathlib import Path

import pytest
import torch
from analytic import cameras_at, on_circle

from univoxel.data import Photos
from univoxel.preparation.light_frame import surroundings_stand_still

VIEWS, SIZE = 12, 128


def photos(color):
    """Views [V, H, W] grey on a ring around a disc in the middle of each."""
    y, x = torch.meshgrid(*2 * [torch.arange(SIZE) - SIZE / 2], indexing="ij")
    alpha = ((x.square() + y.square()).sqrt() < SIZE / 4).byte() * 255
    rgb = (255 * color).byte()[..., None].expand(-1, -1, -1, 3).contiguous()
    alpha = alpha.expand(VIEWS, -1, -1).contiguous()
    cameras = cameras_at(on_circle(VIEWS, 3.0, 0.0), SIZE, 200.0)
    return Photos(Path("ring"), [f"{v}" for v in range(VIEWS)], rgb, alpha, cameras)


@pytest.fixture
def room():
    """Blobs some 8 pixels wide, in [0, 1]: [H, W]."""
    coarse = torch.rand(1, 1, SIZE // 8, SIZE // 8, generator=torch.Generator().manual_seed(3))
    return torch.nn.functional.interpolate(coarse, (SIZE, SIZE), mode="bicubic")[0, 0].clamp(0, 1)


def test_a_camera_that_stands_still_or_is_nudged(room):
    noise = 0.02 * torch.randn(VIEWS, SIZE, SIZE, generator=torch.Generator().manual_seed(4))
    assert surroundings_stand_still(photos((room + noise).clamp(0, 1))) is True
    nudged = torch.stack([room.roll(v % 3, 1) for v in range(VIEWS)])
    assert surroundings_stand_still(photos(nudged)) is True


@pytest.mark.parametrize("pixels", [10, 25])
def test_a_camera_that_goes_around(room, pixels):
    shifting = torch.stack([room.roll(pixels * v, 1) for v in range(VIEWS)])
    assert surroundings_stand_still(photos(shifting)) is False


def test_what_was_cut_away_and_a_plain_wall_tell_nothing():
    assert surroundings_stand_still(photos(torch.zeros(VIEWS, SIZE, SIZE))) is None
    slope = torch.linspace(0.3, 0.6, SIZE).expand(VIEWS, SIZE, SIZE)
    assert surroundings_stand_still(photos(slope)) is None
