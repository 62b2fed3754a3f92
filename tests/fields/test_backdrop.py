"""Pictures on spheres behind an object: where rays meet them, and what hides what."""

import math

import pytest
import torch
from torch.nn.functional import normalize

from univoxel.fields.backdrop import SHELLS, Backdrop, looked_up
from univoxel.records import Rays

CENTRE = torch.tensor([0.5, -0.2, 0.1])


def logit(x):
    return math.log(x / (1 - x))


def rays_from(origin, count=200):
    torch.manual_seed(0)
    direction = normalize(torch.randn(count, 3), dim=1)
    return Rays(torch.tensor(origin).expand(count, 3), direction)


def painted(shell, opaque):
    """A backdrop that is grey of 0.2 far away; one sphere is 0.8 above, 0.4 below."""
    backdrop = Backdrop(CENTRE, 1.0)
    with torch.no_grad():
        backdrop.color.fill_(logit(0.2))
        backdrop.opaque.fill_(-30.0)
        backdrop.opaque[shell] = logit(opaque)
        half = backdrop.color.shape[2] // 2
        backdrop.color[shell, :, half:] = logit(0.8)
        backdrop.color[shell, :, :half] = logit(0.4)
    return backdrop


@pytest.mark.parametrize("origin", [[0.5, -0.2, 0.1], [3.0, 1.0, 0.5]])  # inside and outside
def test_rays_meet_the_far_side_of_a_sphere(origin):
    backdrop, shell, opaque = painted(1, 0.75), 1, 0.75
    rays = rays_from(origin)
    radius = 2.0**shell
    t = torch.linspace(0, 12, 6001)
    points = rays.origin[:, None] + t[None, :, None] * rays.direction[:, None] - CENTRE
    inside = points.norm(dim=2) < radius
    last = (inside * torch.arange(len(t))).amax(1)  # by marching, not by the formula
    height = points[torch.arange(len(last)), last, 2]
    sphere = torch.where(height > 0, 0.8, 0.4)
    expected = torch.where(inside.any(1), opaque * sphere + (1 - opaque) * 0.2, 0.2)
    clear = height.abs() > 0.05  # of the seam between the halves
    found = backdrop(rays)[:, 0]
    torch.testing.assert_close(found[clear], expected[clear], atol=1e-3, rtol=0)
    assert clear.sum() > 150


def test_an_inner_sphere_hides_an_outer():
    backdrop = painted(0, 1 - 1e-6)
    with torch.no_grad():
        backdrop.opaque[2] = 30.0
        backdrop.color[2] = logit(0.6)
    rays = rays_from(CENTRE.tolist())
    z = rays.direction[:, 2]
    clear = z.abs() > 0.05
    found = backdrop(rays)[clear, 0]
    torch.testing.assert_close(found, torch.where(z[clear] > 0, 0.8, 0.4), atol=1e-3, rtol=0)


def test_textures_have_no_seam_and_meet_their_pixels():
    torch.manual_seed(0)
    texture = torch.rand(1, 2, 6, 12)
    row, column = torch.meshgrid(torch.arange(6), torch.arange(12), indexing="ij")
    up = math.pi * ((row + 0.5) / 6 - 0.5)
    around = 2 * math.pi * (column + 0.5) / 12 - math.pi
    direction = torch.stack([up.cos() * around.cos(), up.cos() * around.sin(), up.sin()], -1)
    found = looked_up(texture, direction.reshape(1, -1, 3))
    expected = texture[0].flatten(1).T
    torch.testing.assert_close(found[0], expected, atol=1e-5, rtol=1e-5)
    beside = torch.tensor([[-1.0, 1e-4, 0.0], [-1.0, -1e-4, 0.0]])
    left, right = looked_up(texture, beside[None])[0]
    torch.testing.assert_close(left, right, atol=1e-3, rtol=0)


def test_every_sphere_learns():
    backdrop = Backdrop(CENTRE, 1.0)
    with torch.no_grad():
        backdrop.color.normal_()
    backdrop(rays_from([0.0, 0.0, 0.0])).sum().backward()
    assert all(backdrop.color.grad[k].any() for k in range(SHELLS))
    assert all(backdrop.opaque.grad[k].any() for k in range(SHELLS - 1))
