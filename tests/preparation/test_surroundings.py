"""What stands around an object, as a still and as a moving camera see it."""

from pathlib import Path

import pytest
import torch

from univoxel.camera import Cameras
from univoxel.data import Photos
from univoxel.preparation.light_frame import surroundings_stand_still

VIEWS, SIZE = 12, 128


def photos(color):
    """Views [V, H, W] grey on a ring around a disc in the middle of each."""
    angle = 2 * torch.pi * torch.arange(VIEWS) / VIEWS
    zero, one = torch.zeros(VIEWS), torch.ones(VIEWS)
    away = torch.stack([angle.cos(), angle.sin(), zero], 1)
    right, up = torch.stack([-angle.sin(), angle.cos(), zero], 1), torch.stack([zero, zero, one], 1)
    pose = torch.stack([right, up, away, 3 * away], 2)
    lens = torch.full((VIEWS, 2), 200.0), torch.full((VIEWS, 2), SIZE / 2)
    y, x = torch.meshgrid(*2 * [torch.arange(SIZE) - SIZE / 2], indexing="ij")
    alpha = ((x.square() + y.square()).sqrt() < SIZE / 4).byte() * 255
    rgb = (255 * color).byte()[..., None].expand(-1, -1, -1, 3).contiguous()
    return Photos(
        folder=Path("ring"),
        names=[f"{v}" for v in range(VIEWS)],
        color=rgb,
        alpha=alpha.expand(VIEWS, -1, -1).contiguous(),
        cameras=Cameras(pose, *lens, SIZE, SIZE),
    )


@pytest.fixture
def room():
    """Blobs some 8 pixels wide, in [0, 1]: [H, W]."""
    coarse = torch.rand(1, 1, SIZE // 8, SIZE // 8, generator=torch.Generator().manual_seed(3))
    return torch.nn.functional.interpolate(coarse, (SIZE, SIZE), mode="bicubic")[0, 0].clamp(0, 1)


def test_a_camera_that_stands_still(room):
    noise = 0.02 * torch.randn(VIEWS, SIZE, SIZE, generator=torch.Generator().manual_seed(4))
    assert surroundings_stand_still(photos((room + noise).clamp(0, 1))) is True


def test_a_camera_that_is_nudged(room):
    nudged = torch.stack([room.roll(v % 3, 1) for v in range(VIEWS)])
    assert surroundings_stand_still(photos(nudged)) is True


@pytest.mark.parametrize("pixels", [10, 25])
def test_a_camera_that_goes_around(room, pixels):
    shifting = torch.stack([room.roll(pixels * v, 1) for v in range(VIEWS)])
    assert surroundings_stand_still(photos(shifting)) is False


def test_what_was_cut_away_tells_nothing():
    assert surroundings_stand_still(photos(torch.zeros(VIEWS, SIZE, SIZE))) is None


def test_a_plain_wall_tells_nothing():
    slope = torch.linspace(0.3, 0.6, SIZE).expand(VIEWS, SIZE, SIZE)
    assert surroundings_stand_still(photos(slope)) is None
