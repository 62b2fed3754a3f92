"""Spherical Gaussian shading: native against reference, closed forms, extremes."""

import torch
from check_op import SHADING_RTOL, check_op, uniform, unit

from univoxel import sphere
from univoxel.ops import shade_sg, shade_sg_reference


def points(n, lobes, count, seed=0, roughness=(0.2, 1.0), f0=0.04):
    g = torch.Generator().manual_seed(seed)
    normal = unit(g, n)
    tensors = [
        unit(g, n, lobes),
        uniform(g, 0.1, 30, n, lobes),
        uniform(g, 0, 2, n, lobes, 3),
        normal,
        torch.nn.functional.normalize(normal + 0.8 * unit(g, n), dim=-1),
        uniform(g, 0, 1, n, 3),
        uniform(g, *roughness, n),
    ]
    directions = sphere.fibonacci_hemisphere(count, torch.float64)
    return *[t.requires_grad_() for t in tensors], directions, uniform(g, 0, 6.28, n), f0


def test_native_equals_reference():
    cases = [
        points(3, 4, 37),
        points(1, 1, 1, f0=0.5),
        points(2, 0, 16),
        points(0, 3, 16),
        points(4, 2, 64, roughness=(0.05, 0.2), f0=0.0),
    ]
    check_op(shade_sg, shade_sg_reference, cases, rtol=SHADING_RTOL)


def metals(case, seed=1):
    """The same points with an F0 per channel, black and white among them."""
    f0 = uniform(torch.Generator().manual_seed(seed), 0, 1, len(case[3]), 3)
    f0[:1, 0], f0[:1, 1] = 0, 1
    return *case[:9], f0.requires_grad_()


def test_metals_native_equals_reference():
    cases = [
        metals(points(3, 4, 37)),
        metals(points(2, 0, 16)),
        metals(points(0, 3, 16)),
        metals(points(4, 2, 64, roughness=(0.05, 0.2))),
    ]
    behind = list(metals(points(3, 2, 20)))
    behind[4] = (-behind[4].detach()).requires_grad_()
    behind[7] = sphere.fibonacci_sphere(20, torch.float64)
    check_op(shade_sg, shade_sg_reference, [*cases, tuple(behind)], rtol=SHADING_RTOL)


def test_exponential_is_accurate():
    """One direction straight up and lobes straight down: rgb is exp(-2 s) times a constant."""
    s = torch.linspace(0, 40, 5001)  # 2 s is exact; exp(-80) / 300 is still a normal number
    n = len(s)
    up = torch.tensor([0.0, 0, 1]).expand(n, 3)
    one = torch.ones(n, 1, 3)
    args = (one, up, up, torch.zeros(n, 3), torch.ones(n), up[:1], torch.zeros(n))
    rgb = shade_sg(-up[:, None], s[:, None], *args)[:, 0].double()
    relative = rgb / rgb[0] / torch.exp(-2 * s.double()) - 1
    # 2 ulp for the power of two, half an ulp for each of the few products around it; and sharpness
    # times log2 e is rounded, which is as if sharpness were off by less than an ulp.
    assert bool((relative.abs() < 4 * 2**-23 + 2 * s.double() * 2**-23).all())
