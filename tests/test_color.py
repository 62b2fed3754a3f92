"""The sRGB curve: round trip, its two pieces, its gradient."""

import pytest
import torch

from univoxel import color


def test_all_bytes_survive_a_round_trip():
    byte = torch.arange(256)
    back = color.linear_to_srgb(color.srgb_to_linear(byte.float() / 255))
    assert torch.equal((back * 255).round().long(), byte)


def test_known_values():
    """IEC 61966-2-1: the linear piece, the middle grey of 8 bits, and white."""
    srgb = torch.tensor([0.02, 128 / 255, 1.0], dtype=torch.float64)
    linear = color.srgb_to_linear(srgb)
    assert linear.tolist() == pytest.approx([0.02 / 12.92, 0.2158605, 1.0], abs=1e-7)
    assert color.linear_to_srgb(torch.tensor([-1.0, 2.0])).tolist() == pytest.approx([0.0, 1.0])


def test_gradient_is_finite_everywhere_and_right_inside():
    x = torch.tensor([0.001, 0.2, 0.9], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(color.linear_to_srgb, [x])
    x = torch.tensor([0.0, 1.0, -0.5, 1.5], requires_grad=True)
    (grad,) = torch.autograd.grad(color.linear_to_srgb(x).sum(), x)
    assert bool(grad.isfinite().all())
    assert grad[2:].tolist() == [0.0, 0.0]


def test_luminance_of_white_is_one():
    assert float(color.luminance(torch.ones(3))) == pytest.approx(1.0)
    assert color.luminance(torch.tensor([[1.0, 0.0, 0.0]])).tolist() == pytest.approx([0.2126])


def test_the_unclipped_curve_goes_on_above_one():
    x = torch.tensor([0.0, 0.001, 0.2, 1.0])
    torch.testing.assert_close(color.linear_to_srgb_unclipped(x), color.linear_to_srgb(x))
    bright = torch.tensor([3.0], requires_grad=True)
    color.linear_to_srgb_unclipped(bright).sum().backward()
    assert color.linear_to_srgb_unclipped(bright).item() > 1
    assert bright.grad.item() > 0
    x = torch.tensor([0.0, 0.001, 0.00313, 0.0032, 0.1, 0.9, 3.0], dtype=torch.float64)
    x.requires_grad_()
    (slope,) = torch.autograd.grad(color.linear_to_srgb_unclipped(x[1:]).sum(), x)
    assert torch.allclose(color.srgb_slope(x.detach())[1:], slope[1:], rtol=1e-6)
    assert color.srgb_slope(x.detach())[0] == 12.92
