"""Photographs of a turntable that were placed off its circle are named, and nothing else is."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from analytic import look_at

from univoxel.camera import Cameras, image_rays
from univoxel.data import Photos
from univoxel.preparation.light_frame import find_strays, say_strays
from univoxel.preparation.prepare import find_silhouettes
from univoxel.presets import preset

VIEWS, SIZE = 16, 64
WRONG = slice(13, VIEWS)
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


def test_cameras_off_the_circle_are_named(photos, caplog):
    say_strays(astray(photos))
    assert "3 of 16 camera poses are up to 1.8 degrees off the circle" in caplog.text
    assert "(median of the others: 0.0)" in caplog.text
    assert "Surfaces that only p_13, p_14, p_15 show will not fit" in caplog.text


def test_cameras_on_the_circle_are_right(photos, caplog):
    say_strays(photos)
    wobbling = photos.cameras.camera_to_world.clone()
    wobbling[:, :, 3] += 0.002 * torch.randn(VIEWS, 3, generator=torch.Generator().manual_seed(1))
    say_strays(replace(photos, cameras=replace(photos.cameras, camera_to_world=wobbling)))
    assert not caplog.text


def test_who_walks_around_may_step_aside(caplog):
    """Surroundings that shift are of a camera that moved: there is no circle to keep to."""
    assert find_strays(astray(photographs(still=False))) is None
    assert not caplog.text


def test_surroundings_that_were_cut_away_tell_nothing(photos):
    bare = replace(photos, color=photos.color * (photos.alpha > 0)[..., None])
    assert find_strays(astray(bare)) is None


def test_training_says_it_unless_cameras_are_given(photos, caplog):
    for wanted, said in (("given", False), ("auto", True)):
        cfg = replace(preset("draft", Path("table"), Path("run")), cameras=wanted)
        silhouettes = find_silhouettes(astray(photos), cfg)
        assert len(silhouettes.photos) == VIEWS  # none is left out
        assert ("off the circle" in caplog.text) == said
