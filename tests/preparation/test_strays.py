"""Photographs of a turntable that were placed off its circle: left out, and nothing else is."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from analytic import look_at

from univoxel.camera import Cameras, image_rays
from univoxel.data import Photos
from univoxel.preparation.prepare import find_silhouettes, prepare
from univoxel.preparation.strays import find_strays
from univoxel.presets import preset
from univoxel.training.pixels import split_pixels

VIEWS, SIZE = 16, 64
WRONG = torch.arange(VIEWS) >= 13
HALF = torch.tensor([0.45, 0.12, 0.2])  # of a box


def photographs(still: bool = True) -> Photos:
    """A box turned before a camera that stands still, or that goes around it."""
    angle = 2 * math.pi * torch.arange(VIEWS) / VIEWS
    place = torch.stack([2 * angle.cos(), 2 * angle.sin(), torch.full((VIEWS,), 0.7)], 1)
    poses = torch.stack([look_at(p) for p in place])
    lens = torch.full((VIEWS, 2), 1.4 * SIZE), torch.full((VIEWS, 2), SIZE / 2)
    cameras = Cameras(poses, *lens, SIZE, SIZE)
    coarse = torch.rand(1, 1, 12, 12, generator=torch.Generator().manual_seed(3))
    room = torch.nn.functional.interpolate(coarse, (SIZE, SIZE), mode="bicubic")[0, 0].clamp(0, 1)
    rooms = torch.stack([room if still else room.roll(9 * v, 1) for v in range(VIEWS)])
    shown = torch.stack([hits(cameras, view) for view in range(VIEWS)])
    color = (255 * torch.where(shown, 0.4, rooms)).byte()[..., None].expand(-1, -1, -1, 3)
    alpha = 255 * shown.byte()
    return Photos(Path("table"), [f"p_{v}" for v in range(VIEWS)], color.clone(), alpha, cameras)


def hits(cameras: Cameras, view: int) -> torch.Tensor:
    """Which pixels [H, W] see the box."""
    rays = image_rays(cameras, view)
    sides = torch.stack([(s * HALF - rays.origin) / rays.direction for s in (-1, 1)])
    near, far = sides.amin(0).amax(1), sides.amax(0).amin(1)
    return (near < far).reshape(SIZE, SIZE)


def astray(photos: Photos, degrees: float = -8.0, outwards: float = 0.03) -> Photos:
    """The last three turned back about the axis, to where the box is broader, and further out."""
    turn, pose = math.radians(degrees), photos.cameras.camera_to_world.clone()
    about = torch.tensor(
        [[math.cos(turn), -math.sin(turn), 0], [math.sin(turn), math.cos(turn), 0], [0, 0, 1.0]]
    )
    pose[WRONG] = about @ pose[WRONG]
    pose[WRONG, :, 3] *= 1 + outwards
    return replace(photos, cameras=replace(photos.cameras, camera_to_world=pose))


@pytest.fixture(scope="module")
def photos():
    return photographs()


def configured(**changes):
    return replace(preset("draft", Path("table"), Path("run")), **changes)


def test_cameras_off_the_circle_are_named_and_left_out(photos, caplog):
    found = find_strays(astray(photos), "auto")
    assert torch.equal(found, WRONG)
    assert "3 of 16 photographs were placed off the circle of their turntable" in caplog.text
    assert "left out are p_13, p_14, p_15; `univoxel poses`" in caplog.text


def test_cameras_on_the_circle_stay(photos, caplog):
    assert find_strays(photos, "auto") is None
    wobbling = photos.cameras.camera_to_world.clone()
    wobbling[:, :, 3] += 0.002 * torch.randn(VIEWS, 3, generator=torch.Generator().manual_seed(1))
    wobbling = replace(photos.cameras, camera_to_world=wobbling)
    assert find_strays(replace(photos, cameras=wobbling), "auto") is None
    assert not caplog.text


def test_who_walks_around_may_step_aside(caplog):
    """Surroundings that shift are of a camera that moved: there is no circle to keep to."""
    assert find_strays(astray(photographs(still=False)), "auto") is None
    assert not caplog.text


def test_surroundings_that_were_cut_away_tell_nothing(photos):
    bare = replace(photos, color=photos.color * (photos.alpha > 0)[..., None])
    assert find_strays(astray(bare), "auto") is None


@pytest.mark.parametrize("wanted", ["given", "refined"])
def test_what_is_wanted_is_done(photos, wanted):
    assert find_strays(astray(photos), wanted) is None


def hull_of(photos: Photos, **changes) -> torch.Tensor:
    """What training begins with."""
    cfg = configured(hollows=0.0, masks="given", **changes)
    return prepare(find_silhouettes(photos, cfg), cfg).hull


def test_those_left_out_carve_nothing(photos):
    off = astray(photos)
    left = hull_of(off)
    torch.testing.assert_close(left, hull_of(off.of((~WRONG).nonzero()[:, 0])))
    used = hull_of(off, cameras="given")
    assert used.shape != left.shape or (used > left + 0.01).any()


def test_nothing_is_learned_from_those_left_out(photos):
    silhouettes = find_silhouettes(astray(photos), configured())
    assert silhouettes.doubted is not None
    assert torch.equal(silhouettes.doubted.flatten(1).all(1), WRONG)
    assert len(silhouettes.photos) == VIEWS  # numbers of views stay
    pixels = split_pixels(silhouettes.photos, silhouettes.distance, silhouettes.doubted)
    trained = torch.cat([pixels.trained, pixels.held_out])[:, 0].unique()
    assert trained.tolist() == list(range(13))
    assert not pixels.photos.alpha[WRONG].any()


def test_without_strays_nothing_changes(photos):
    silhouettes = find_silhouettes(photos, configured())
    assert silhouettes.doubted is None
    assert torch.equal(silhouettes.photos.alpha, photos.alpha)
