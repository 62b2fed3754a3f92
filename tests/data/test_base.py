"""Pixels of stored photographs in linear float, whatever they are stored as."""

from pathlib import Path

import pytest
import torch

from univoxel.camera import Cameras
from univoxel.color import srgb_to_linear
from univoxel.data import Photos


def photos(color, alpha):
    views, height, width = alpha.shape
    pose = torch.eye(4)[:3].expand(views, 3, 4)
    cameras = Cameras(pose, torch.ones(views, 2), torch.ones(views, 2), width, height)
    return Photos(Path("nowhere"), [f"r_{v}" for v in range(views)], color, alpha, cameras)


@pytest.fixture
def stored():
    generator = torch.Generator().manual_seed(0)
    return photos(
        torch.randint(0, 256, (2, 3, 4, 3), dtype=torch.uint8, generator=generator),
        torch.randint(0, 256, (2, 3, 4), dtype=torch.uint8, generator=generator),
    )


def test_bytes_are_srgb_and_coverage(stored):
    color, alpha = stored.picture(1)
    torch.testing.assert_close(color, srgb_to_linear(stored.color[1].float() / 255))
    torch.testing.assert_close(alpha, stored.alpha[1].float() / 255)
    assert len(stored) == 2
    torch.testing.assert_close(stored.coverage()[1], alpha)


def test_floats_are_linear_already(stored):
    color, alpha = 7 * torch.rand(2, 3, 4, 3), torch.rand(2, 3, 4)  # radiance may exceed 1
    linear = photos(color, alpha)
    assert torch.equal(linear.picture(0)[0], color[0])
    assert torch.equal(linear.picture(0)[1], alpha[0])
    assert torch.equal(linear.coverage(), alpha)


def test_single_pixels_are_those_of_the_picture(stored):
    view, row, column = torch.tensor([0, 1, 1]), torch.tensor([2, 0, 2]), torch.tensor([3, 1, 0])
    color, alpha = stored.pixels(view, row, column)
    for i in range(3):
        whole = stored.picture(int(view[i]))
        # The power of the sRGB curve rounds as the length of the vector says.
        torch.testing.assert_close(color[i], whole[0][row[i], column[i]])
        assert torch.equal(alpha[i], whole[1][row[i], column[i]])
