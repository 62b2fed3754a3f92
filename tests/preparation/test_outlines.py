"""Edges of rough masks against a disc whose coverage is known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from univoxel.camera import Cameras
from univoxel.data import Photos
from univoxel.preparation.hull import mask_distances
from univoxel.preparation.outlines import drawn_again

SIZE, RADIUS = 64, 20.0


def disc(radius):
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5 - SIZE / 2
    return (0.5 + radius - np.hypot(x, y)).clip(0, 1)


@pytest.fixture
def rough():
    """A photograph of a checkered disc before a grey wall, and its mask, whose edge wavers."""
    random, true = np.random.default_rng(0), disc(RADIUS)
    y, x = np.mgrid[:SIZE, :SIZE]
    checks = ((x // 6 + y // 6) % 2)[..., None]
    object_ = np.where(checks, [0.8, 0.3, 0.2], [0.2, 0.3, 0.7])
    color = true[..., None] * object_ + (1 - true[..., None]) * [0.5, 0.5, 0.5]
    color = (color + 0.01 * random.standard_normal(color.shape)).clip(0, 1)
    angle = np.arctan2(y - SIZE / 2, x - SIZE / 2)
    mask = disc(RADIUS + 2 * np.sin(7 * angle)) >= 0.5
    pose = torch.eye(3, 4)[None]
    cameras = Cameras(pose, torch.full((1, 2), 64.0), torch.full((1, 2), 32.0), SIZE, SIZE)
    color = torch.from_numpy((255 * color).round().astype(np.uint8))[None]
    alpha = torch.from_numpy((255 * mask).astype(np.uint8))[None]
    return Photos(Path(), ["a"], color, alpha, cameras), torch.from_numpy(true).float()


def again(photos, off=3.0, doubted=None):
    doubted = torch.zeros(photos.alpha.shape, dtype=torch.bool) if doubted is None else doubted
    return drawn_again(photos, mask_distances(photos.coverage()), off, doubted)


def test_an_edge_that_wavers_is_moved_to_the_outline(rough):
    photos, true = rough
    before, after = ((c[0] - true).abs().sum() for c in (photos.coverage(), again(photos)))
    assert before > 150
    assert after < before / 4  # what is left: mixed colours look like both


def test_where_object_and_wall_have_one_colour_the_mask_stays(rough):
    photos, _ = rough
    noise = torch.randint(126, 130, photos.color.shape, generator=torch.Generator().manual_seed(0))
    photos = replace(photos, color=noise.byte())
    moved = (again(photos) - photos.coverage()).abs()
    assert ((again(photos) >= 0.5) != (photos.alpha > 0)).float().mean() < 0.02
    assert moved.mean() < 0.03


def test_of_an_object_that_was_cut_out_the_mask_stays(rough):
    photos, _ = rough
    black = (photos.alpha == 0) | (
        photos.color[..., 2] > photos.color[..., 0]
    )  # half of the checks
    photos = replace(photos, color=photos.color * ~black[..., None])
    assert torch.equal(again(photos), photos.coverage())


def test_no_edge_is_moved_further_than_it_may_be_off(rough):
    photos, _ = rough
    far = mask_distances(photos.coverage()).abs() > 1.0
    assert torch.equal(again(photos, 1.0)[far], photos.coverage()[far])


def test_what_is_doubted_stays(rough):
    photos, _ = rough
    doubted = torch.zeros(photos.alpha.shape, dtype=torch.bool)
    doubted[:, :, :32] = True
    found = again(photos, doubted=doubted)
    assert torch.equal(found[doubted], photos.coverage()[doubted])
    assert not torch.equal(found, photos.coverage())


def test_masks_without_an_edge_stay(rough):
    photos, _ = rough
    for value in (0, 255):
        full = replace(photos, alpha=torch.full_like(photos.alpha, value))
        assert torch.equal(again(full, torch.inf), full.coverage())


def test_colours_from_far_away_tell_nothing(rough):
    photos, true = rough
    object_ = torch.tensor([[180, 150, 110], [20, 40, 200]])  # above, below
    painted = object_[(torch.arange(SIZE) >= 40).long()][:, None].expand(SIZE, SIZE, 3)
    wall = torch.randint(126, 130, (SIZE, SIZE, 3), generator=torch.Generator().manual_seed(0))
    color = torch.where(true[..., None] > 0.5, painted, wall).byte()[None]
    photos = replace(photos, color=color, alpha=(255 * true).round().byte()[None])
    doubted = mask_distances(photos.coverage()) < -2
    doubted[:, 44:] = False  # what is surely the object is at the bottom alone
    found = again(photos, doubted=doubted)[0, :20]
    assert ((found >= 0.5) != (true[:20] >= 0.5)).sum() < 5
