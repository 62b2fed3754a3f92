"""Hollows opened before training: which photographs say so, and whether there is time."""

import dataclasses

import pytest
import torch
from analytic import RADIUS, photos_of

from univoxel.color import linear_to_srgb
from univoxel.fields.grid import fit_grid
from univoxel.preparation import carving as task


@pytest.fixture
def hull():
    grid = fit_grid(torch.tensor([-1.0] * 3), torch.tensor([1.0] * 3), 40_000)
    return (grid.nodes().norm(dim=-1) - RADIUS).view(*grid.size), grid


@pytest.mark.parametrize(("share", "opens"), [(0.8, False), (1.25, True)])
@pytest.mark.parametrize("bits", [True, False])
def test_hollows_are_opened_where_little_time_is_expected(monkeypatch, hull, share, opens, bits):
    """Seconds are a share of what the silhouettes' pixels take, shrunk to a voxel's width."""
    sdf, grid = hull
    monkeypatch.setattr(task, "carve_concavities", lambda hull, *_: hull + 0.25)
    photos = photos_of(3, 64)
    if bits:
        photos = dataclasses.replace(photos, alpha=(255 * photos.alpha).round().byte())
    pictures, _ = task.carving_pictures(photos, grid.voxel_size)
    assert pictures.shape[1] == 32  # so that shrinking counts
    pixels = pictures[..., 3].float().sum() / 255
    found = task.carve_within_time(
        sdf, grid, photos, None, share * task.PIXEL_SECONDS * float(pixels)
    )
    assert torch.equal(found, sdf + 0.25 if opens else sdf)


def test_time_is_not_expected_of_photographs_that_are_left_out(monkeypatch, hull):
    sdf, grid = hull
    monkeypatch.setattr(task, "carve_concavities", lambda hull, *_: hull + 0.25)
    monkeypatch.setattr(task, "VIEWS", 4)
    seconds = task.PIXEL_SECONDS * 5 * 32**2  # of four whole pictures, and more
    assert torch.equal(
        task.carve_within_time(sdf, grid, photos_of(40, 64), None, seconds), sdf + 0.25
    )


def test_pictures_are_shrunk_to_what_a_voxel_shows():
    """Pixels are 0.028 wide at the object."""
    photos = photos_of(3, 64)
    pictures, cameras = task.carving_pictures(photos, 0.06)
    assert pictures.shape == (3, 32, 32, 4)
    assert (cameras.width, cameras.height) == (32, 32)
    torch.testing.assert_close(cameras.focal * 2, photos.cameras.focal)
    torch.testing.assert_close(cameras.centre * 2, photos.cameras.centre)
    color, alpha = photos.picture(1)
    whole = torch.cat([linear_to_srgb(color) * alpha[..., None], alpha[..., None]], -1)
    wanted = 255 * whole[20:22, 24:26].mean((0, 1))
    torch.testing.assert_close(pictures[1, 10, 12].float(), wanted, rtol=0, atol=0.51)  # rounded
    assert task.carving_pictures(photos, 0.02)[0].shape == (3, 64, 64, 4)


def test_pictures_are_as_one_exposure_would_have_them():
    photos, gains = photos_of(3, 64), torch.tensor([0.4, 0.0, -0.4])
    photos = dataclasses.replace(photos, color=photos.color / 3)  # nothing is clipped
    exposed = photos.color * gains.exp()[:, None, None, None]
    exposed = dataclasses.replace(photos, color=exposed)
    wanted = task.carving_pictures(photos, 0.06)[0].int()
    found = task.carving_pictures(exposed, 0.06, gains)[0].int()
    assert (found - wanted).abs().max() <= 1  # rounded
    assert (task.carving_pictures(exposed, 0.06)[0].int() - wanted).abs().max() > 10


def test_of_many_photographs_some_say_what_is_hollow(monkeypatch):
    monkeypatch.setattr(task, "VIEWS", 4)
    photos = photos_of(10, 16)
    pictures, cameras = task.carving_pictures(photos, 0.01)
    assert len(pictures) == len(cameras) == 4
    torch.testing.assert_close(cameras.camera_to_world, photos.cameras.camera_to_world[::3])
    assert torch.equal(pictures[2, ..., 3], (255 * photos.alpha[6]).round().byte())
