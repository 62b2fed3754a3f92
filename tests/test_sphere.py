"""Every map of directions: round trips, solid angles, poles; and sides in words."""

import math

import numpy as np
import pytest
import torch

from univoxel import sphere


@pytest.mark.parametrize("count", [1, 7, 256])
def test_fibonacci_sets(count):
    half = sphere.fibonacci_hemisphere(count, torch.float64)
    full = sphere.fibonacci_sphere(count, torch.float64)
    for w in (half, full):
        torch.testing.assert_close(w.norm(dim=-1), torch.ones(count).double())
    assert bool((half[:, 2] > 0).all())
    # Equal solid angles: the mid-point rule in z is exact for z.
    assert float(half[:, 2].mean()) == pytest.approx(0.5)
    assert float(full[:, 2].mean()) == pytest.approx(0.0, abs=1e-12)


def test_fibonacci_integrates_with_rising_order():
    """The integral of x^2 over the half-sphere is 2 pi / 3."""
    errors = []
    for count in (64, 256, 1024):
        x = sphere.fibonacci_hemisphere(count, torch.float64)[:, 0]
        errors.append(abs(float((x * x).mean()) - 1 / 3))
    assert errors[0] < 1e-2
    assert errors[2] < errors[0] / 8


@pytest.mark.parametrize("make", [sphere.fibonacci_hemisphere, sphere.fibonacci_sphere])
def test_fibonacci_needs_a_direction(make):
    with pytest.raises(ValueError, match="count must be at least 1, got 0"):
        make(0)


def normals():
    poles = torch.tensor([[0.0, 0, 1], [0, 0, -1], [1, 0, 0], [1, 0, -0.0]], dtype=torch.float64)
    return torch.cat([poles, sphere.fibonacci_sphere(200, torch.float64)])


def test_frame_is_orthonormal_and_right_handed():
    n = normals()
    t, b = sphere.frame(n)
    basis = torch.stack([t, b, n], 1)
    eye = torch.eye(3).double().expand(len(n), 3, 3)
    torch.testing.assert_close(basis @ basis.mT, eye, atol=1e-12, rtol=0)
    torch.testing.assert_close(torch.linalg.det(basis), torch.ones(len(n)).double())
    assert torch.autograd.gradcheck(sphere.frame, n[4:].clone().requires_grad_())
    zero = torch.zeros(1, 3, requires_grad=True)
    (grad,) = torch.autograd.grad(sum(v.sum() for v in sphere.frame(zero)), zero)
    assert bool(grad.isfinite().all())
    up = torch.tensor([0.0, 0, 1]).double()
    torch.testing.assert_close(sphere.to_world(up, n), n)


def test_rotate_z_turns_counter_clockwise():
    x = torch.tensor([1.0, 0, 0.5])
    got = sphere.rotate_z(x, torch.tensor(math.pi / 2))
    torch.testing.assert_close(got, torch.tensor([0.0, 1, 0.5]), atol=1e-6, rtol=0)


def test_latlong():
    uv = torch.tensor([[0.5, 0.5], [0.25, 0.5], [0.75, 0.5], [0.5, 0.0], [0.0, 0.5]]).double()
    wanted = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [-1, 0, 0]]).double()
    torch.testing.assert_close(sphere.latlong_direction(uv), wanted, atol=1e-12, rtol=0)
    d = sphere.fibonacci_sphere(500, torch.float64)
    torch.testing.assert_close(sphere.latlong_direction(sphere.direction_to_latlong(d)), d)
    torch.testing.assert_close(sphere.direction_to_latlong(3 * d), sphere.direction_to_latlong(d))
    d.requires_grad_()
    assert torch.autograd.gradcheck(sphere.direction_to_latlong, d[:20])
    d = torch.tensor([[0.0, 0, 1], [0, 0, -1], [0, 0, 0]], requires_grad=True)
    uv = sphere.direction_to_latlong(d)  # at the poles, and nowhere
    torch.testing.assert_close(uv, torch.tensor([[0.5, 0.0], [0.5, 1.0], [0.5, 0.5]]))
    (grad,) = torch.autograd.grad(uv.sum(), d)
    assert bool(grad.isfinite().all())


def test_texel_solid_angles():
    area = sphere.texel_solid_angles(6, 12)
    assert area.shape == (6, 12)
    assert float(area.sum()) == pytest.approx(4 * math.pi, rel=1e-6)
    v = (torch.arange(600).double() + 0.5) / 600
    row = 2 * math.pi / 12 * (torch.sin(math.pi * v) * math.pi / 600).reshape(6, 100).sum(1)
    torch.testing.assert_close(area[:, 0].double(), row, rtol=1e-4, atol=0)


def _directions(azimuths, height=40.0):
    """Counter-clockwise from the first photograph's side, which is -Y."""
    phi, up = np.radians(np.array(azimuths) - 90.0), np.radians(height)
    return np.stack([np.cos(phi) * np.cos(up), np.sin(phi) * np.cos(up), 0 * phi + np.sin(up)], 1)


def test_gaps_are_told_by_side_and_by_the_photographs_beside():
    names = [f"{a}.jpg" for a in (0, 50, 150, 200, 250, 305)]
    directions = _directions([0, 50, 150, 200, 250, 305])
    # Who stands where the first photograph was taken and looks at the object has +X at the right
    assert sphere.gaps(directions, names, 60.0) == [
        "no photograph from the right: there is a gap of 100 degrees between 50.jpg and 150.jpg"
    ]
    names = [f"{a}.jpg" for a in (0, 50, 100, 150, 200)]
    assert sphere.gaps(_directions([0, 50, 100, 150, 200]), names, 60.0) == [
        "no photograph from the left: there is a gap of 160 degrees between 200.jpg and 0.jpg"
    ]
    all_around = list(range(0, 360, 30))
    assert sphere.gaps(_directions(all_around), [""] * 12, 60.0) == []
    assert sphere.gaps(_directions(all_around, 12.0), [""] * 12, 60.0) == [
        "no photograph from more than 12 degrees above the horizon"
    ]
    turned = [(a + 70) % 360 for a in (0, 50, 100, 150, 200)]
    assert sphere.gaps(_directions(turned), names, 60.0, front=-20.0)[0].startswith(
        "no photograph from the left: there is a gap of 160 degrees"
    )
