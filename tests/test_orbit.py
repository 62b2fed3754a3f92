"""The circle that cameras stand on, and those that do not stand with the others."""

import math
from dataclasses import replace

import pytest
import torch
from analytic import cameras_around, look_at
from scipy.spatial.transform import Rotation

from univoxel.camera import Cameras, circle_of

VIEWS = 40
TILT = torch.from_numpy(Rotation.from_rotvec([0.4, -0.3, 0.2]).as_matrix()).float()


def on_a_ring(noise: float = 0.0, turn: float = 2 * math.pi, heights=(0.9,)) -> Cameras:
    """Cameras on a ring of radius 3 in a tilted world, a share of it off by normal numbers."""
    generator = torch.Generator().manual_seed(0)
    angle = turn * torch.arange(VIEWS) / VIEWS
    height = torch.tensor(heights).repeat_interleave(-(-VIEWS // len(heights)))[:VIEWS]
    place = torch.stack([3 * angle.cos(), 3 * angle.sin(), height], 1)
    place = place + 3 * noise * torch.randn(VIEWS, 3, generator=generator)
    poses = torch.stack([look_at(p) for p in place])
    focal = torch.full((VIEWS, 2), 30.0)
    return Cameras(TILT @ poses, focal, torch.full((VIEWS, 2), 16.0), 32, 32)


def moved(cameras: Cameras, views: slice, away: float) -> Cameras:
    """With some of the centres further out, by a share of the ring's radius."""
    pose = cameras.camera_to_world.clone()
    pose[views, :, 3] *= 1 + away
    return replace(cameras, camera_to_world=pose)


def test_a_ring_is_found():
    circle = circle_of(on_a_ring())
    assert circle.radius == pytest.approx(3, abs=1e-4)
    wanted = TILT.double() @ torch.tensor([0, 0, 1.0]).double()
    assert abs(circle.axis @ wanted) == pytest.approx(1, abs=1e-6)
    torch.testing.assert_close(circle.centre, 0.9 * wanted, atol=1e-4, rtol=0)
    assert not circle.strays().any()


def test_normal_errors_are_no_strays():
    circle = circle_of(on_a_ring(noise=0.002))
    assert 0.001 < circle.off.median() < 0.003
    assert not circle.strays().any()


@pytest.mark.parametrize("away", [0.02, -0.03])
def test_cameras_beside_the_ring_are_strays_and_do_not_bend_it(away):
    circle = circle_of(moved(on_a_ring(noise=0.0005), slice(30, 38), away))
    assert circle.strays().nonzero()[:, 0].tolist() == list(range(30, 38))
    assert circle.radius == pytest.approx(3, rel=1e-3)
    wanted = TILT.double() @ torch.tensor([0, 0, 1.0]).double()
    assert abs(circle.axis @ wanted) > math.cos(math.radians(0.1))


def test_what_stands_elsewhere_was_put_there():
    circle = circle_of(moved(on_a_ring(), slice(30, 36), 0.5))
    assert circle is not None
    assert not circle.strays().any()


def test_few_stray_by_hand():
    """A walk around an object stays within some per cent of a circle: it is none."""
    assert circle_of(on_a_ring(noise=0.02)) is None


def test_other_paths_are_no_circle():
    assert circle_of(cameras_around(VIEWS)) is None
    assert circle_of(on_a_ring(heights=(0.5, 1.5))) is None  # two rings, of which none has most
    assert circle_of(on_a_ring(turn=0.6)) is None  # a short arc has any axis
    assert circle_of(on_a_ring().of(torch.arange(6))) is None  # too few
    still = on_a_ring().of(torch.zeros(VIEWS, dtype=torch.int64))
    assert circle_of(still) is None
