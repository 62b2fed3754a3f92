"""Local spherical harmonics: the functions, gradients, a known light found."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.special
import torch
from balls import ball, fit, views

from univoxel import sphere
from univoxel.lights import LocalSH, SHConfig
from univoxel.sphere import real_harmonics


def test_harmonics_are_orthonormal():
    d = sphere.fibonacci_sphere(20000, torch.float64)
    y = real_harmonics(5, d)
    gram = y.T @ y * 4 * math.pi / len(d)
    torch.testing.assert_close(gram, torch.eye(36).double(), atol=1e-4, rtol=0)


def test_harmonics_are_those_of_scipy():
    """From complex ones, and from its Legendre functions with their Condon-Shortley phase."""
    d = sphere.fibonacci_sphere(50, torch.float64)
    x, y, z = d.numpy().T
    phi = np.arctan2(y, x)
    got = real_harmonics(4, d)
    for degree in range(5):
        for m in range(degree + 1):
            square = (2 * degree + 1) / (4 * np.pi)
            square *= scipy.special.factorial(degree - m) / scipy.special.factorial(degree + m)
            wanted = np.sqrt(square) * (-1) ** m * scipy.special.lpmv(m, degree, z)
            if m:
                wanted *= np.sqrt(2)
                sine = torch.from_numpy(wanted * np.sin(m * phi))
                torch.testing.assert_close(got[:, degree * degree + degree - m], sine)
            cosine = torch.from_numpy(wanted * np.cos(m * phi))
            torch.testing.assert_close(got[:, degree * degree + degree + m], cosine)


def test_harmonics_at_the_poles_have_gradients():
    d = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], requires_grad=True)
    real_harmonics(4, d).sum().backward()
    assert bool(d.grad.isfinite().all())
    assert d.grad.abs().max() > 0.1


@pytest.mark.parametrize(("order", "numbers"), [(0, 3), (3, 48), (4, 75)])
def test_numbers_a_point(order, numbers):
    light = LocalSH(4, SHConfig(order=order))
    assert light.coefficients(ball(2))[0].numel() == numbers


def test_gradients_to_normals_materials_and_light():
    surface, light = ball(20), LocalSH(4)
    leaves = [t.clone().requires_grad_() for t in (surface.normal, surface.albedo)]
    surface = replace(surface, normal=leaves[0], albedo=leaves[1])
    light.reflected(surface, views(ball(20))).sum().backward()
    assert all(leaf.grad.abs().min() > 0 for leaf in leaves)
    assert light.head[-1].weight.grad.abs().max() > 0


def test_recovers_a_known_light():
    """A ball under a light of order 2 that stays positive: the fit finds it from its reflection."""
    surface = replace(ball(150, roughness=0.25), features=torch.zeros(150, 4))
    wo = views(surface)
    truth, light = LocalSH(4, SHConfig(order=2)), LocalSH(4, SHConfig(order=2))
    with torch.no_grad():
        truth.base.add_(0.5 * torch.randn(truth.base.shape, generator=torch.manual_seed(1)))
        target = truth.reflected(surface, wo)
    assert fit(light, surface, wo, target, [light.base], 100, 0.05, turned=False) < 1e-3
    wi = sphere.fibonacci_sphere(500)
    got, wanted = (one.incident(surface, wi)[0].detach() for one in (light, truth))
    # all of order 2 shows in diffuse reflection
    assert float((got - wanted).norm() / wanted.norm()) < 0.05
