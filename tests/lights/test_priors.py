"""What is likely of light: the measures against closed forms."""

import math

import pytest
import torch

from univoxel.lights import base
from univoxel.sphere import latlong_directions


def test_chroma_is_of_the_sum_only():
    assert base.chroma(torch.ones(1, 3)).item() == pytest.approx(0.0, abs=1e-6)
    assert base.chroma(torch.tensor([[1.0, 0.0, 0.0]])).item() > 0.5
    # not the brightness: twice the light has the same chroma
    tinted = torch.tensor([[1.0, 0.9, 0.8]])
    assert base.chroma(2 * tinted).item() == pytest.approx(base.chroma(tinted).item())


def test_smoothness_vanishes_where_equal():
    a = torch.rand(5, 7)
    assert base.smoothness(a, a) == 0
    assert base.smoothness(a + 0.5, a).item() == pytest.approx(0.5)


@pytest.mark.parametrize("axis", [[0.0, 0, 1], [1.0, 0, 0], [0.6, 0, 0.8]])
def test_total_variation_of_a_ramp(axis):
    """log L = k axis.w has a gradient of k sin(angle to the axis), wherever the axis points."""
    k = 2.0
    ramp = (k * latlong_directions(128) @ torch.tensor(axis))[..., None].expand(-1, -1, 3)
    t = torch.linspace(0, math.pi, 20001, dtype=torch.float64)
    integrand = ((1 + (k * t.sin()) ** 2).sqrt() - 1) * t.sin() / 2
    wanted = torch.trapezoid(integrand, t).item()
    # the rows beside the poles see the ramp at finite steps: about one in 128 of the map
    assert base.total_variation(ramp).item() == pytest.approx(wanted, rel=0.01)


def test_total_variation_knows_no_seam_and_no_level():
    torch.manual_seed(0)
    noise = torch.randn(16, 32, 3)
    value = base.total_variation(noise)
    torch.testing.assert_close(base.total_variation(noise.roll(5, 1)), value)
    torch.testing.assert_close(base.total_variation(noise + 3), value)
    assert base.total_variation(torch.ones(1, 2, 3)) == 0


def test_an_even_map_has_a_finite_gradient():
    even = torch.ones(8, 16, 3, requires_grad=True)
    base.total_variation(even).backward()
    assert bool(even.grad.isfinite().all())
