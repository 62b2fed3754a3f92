"""Local spherical harmonics: the functions, gradients, a known light found."""

import math

import numpy as np
import pytest
import scipy.special
import torch
from balls import ball

from univoxel import sphere
from univoxel.lights import LocalSH, SHConfig
from univoxel.sphere import real_harmonics


def test_harmonics_are_orthonormal_and_have_gradients_at_the_poles():
    d = sphere.fibonacci_sphere(20000, torch.float64)
    y = real_harmonics(5, d)
    gram = y.T @ y * 4 * math.pi / len(d)
    torch.testing.assert_close(gram, torch.eye(36).double(), atol=1e-4, rtol=0)
    d = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], requires_grad=True)
    real_harmonics(4, d).sum().backward()
    assert bool(d.grad.isfinite().all())
    assert d.grad.abs().max() > 0.1


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


@pytest.mark.parametrize(("order", "numbers"), [(0, 3), (3, 48), (4, 75)])
def test_numbers_a_point(order, numbers):
    light = LocalSH(4, SHConfig(order=order))
    assert light.coefficients(ball(2))[0].numel() == numbers
