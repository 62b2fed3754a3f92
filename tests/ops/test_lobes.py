"""Lobes from raw numbers: native against reference, closed forms, extremes."""

import math

import torch
from check_op import check_op

from univoxel.ops import decode_lobes, decode_lobes_reference

LOW, HIGH = 0.1, 30.0


def parameters(m, scale=2.0, seed=0):
    g = torch.Generator().manual_seed(seed)
    return scale * torch.randn(m, 7, generator=g, dtype=torch.float64)


def case(numbers):
    return numbers.requires_grad_(), LOW, HIGH


def test_native_equals_reference():
    cases = [case(parameters(m, scale)) for m, scale in ((5, 2.0), (64, 0.1), (67, 20.0), (0, 1.0))]
    check_op(decode_lobes, decode_lobes_reference, cases)


def test_closed_forms():
    numbers = torch.tensor([[0.0, -3.0, 4.0, 0.0, 0.0, math.log(math.e - 1), -40.0]])
    axis, sharpness, amplitude = decode_lobes(numbers, LOW, HIGH)
    torch.testing.assert_close(axis, torch.tensor([[0.0, -0.6, 0.8]]))
    torch.testing.assert_close(sharpness, torch.tensor([LOW + HIGH / 2]))
    wanted = torch.tensor([[math.log(2), 1.0, math.exp(-40)]])
    torch.testing.assert_close(amplitude, wanted, rtol=1e-5, atol=0)


def test_short_vectors_are_scaled():
    """The gradient to a vector below the shortest does not turn it: it is 1e6 times the axis's."""
    numbers = torch.zeros(1, 7, dtype=torch.float64)
    numbers[0, :3] = torch.tensor([3e-8, 4e-8, 0.0])
    numbers.requires_grad_()
    axis, *_ = decode_lobes(numbers, LOW, HIGH)
    torch.testing.assert_close(axis, 1e6 * numbers[:, :3])
    (grad,) = torch.autograd.grad(axis @ axis.new_tensor([1.0, 2.0, 3.0]), numbers)
    torch.testing.assert_close(grad[0, :3], grad.new_tensor([1e6, 2e6, 3e6]))


def test_what_is_no_number_stays_none():
    numbers = torch.full((1, 7), math.nan)
    for x in decode_lobes(numbers, LOW, HIGH):
        assert x.isnan().all()


def test_a_gradient_of_some_outputs():
    numbers = parameters(6).requires_grad_()
    for k in range(3):
        got, wanted = (
            torch.autograd.grad(op(numbers, LOW, HIGH)[k].square().sum(), numbers)[0]
            for op in (decode_lobes, decode_lobes_reference)
        )
        torch.testing.assert_close(got, wanted)
