"""Compositing: native against reference, closed forms."""

import pytest
import torch
from check_op import check_op

from univoxel.ops import composite, composite_reference


def rays(counts, channels=3, seed=0):
    g = torch.Generator().manual_seed(seed)
    m = sum(counts)
    alpha = torch.rand(m, generator=g, dtype=torch.float64).requires_grad_()
    value = torch.randn(m, channels, generator=g, dtype=torch.float64).requires_grad_()
    offsets = torch.tensor([0, *counts]).cumsum(0)
    return alpha, value, offsets


def test_native_equals_reference():
    cases = [
        rays([3, 0, 1, 7]),
        rays([0, 0]),
        rays([]),
        rays([5], channels=1),
        rays([4, 9], channels=17),
        (*rays([40, 30, 20]), 0.05),
    ]
    check_op(composite, composite_reference, cases, custom_op=None)


def test_weights_and_transmittance_sum_to_one():
    alpha, value, offsets = rays([6, 4])
    _, weight = composite(alpha, value, offsets)
    for a, w in zip(alpha.split([6, 4]), weight.split([6, 4]), strict=True):
        torch.testing.assert_close(w.sum() + (1 - a).prod(), torch.tensor(1.0).double())


def test_opaque_sample_has_exact_gradient():
    """alpha = 1 hides what is behind it, and dividing by 1 - alpha would give NaN."""
    alpha = torch.tensor([0.5, 1.0, 0.3], dtype=torch.float64, requires_grad=True)
    value = torch.tensor([[1.0], [2.0], [4.0]], dtype=torch.float64)
    out, _ = composite(alpha, value, torch.tensor([0, 3]))
    (grad,) = torch.autograd.grad(out.sum(), alpha)
    # out = a0 v0 + (1 - a0)(a1 v1 + (1 - a1) a2 v2)
    assert grad.tolist() == pytest.approx([1 - 2, 0.5 * (2 - 0.3 * 4), 0.0])


def test_early_stop_drops_the_tail():
    alpha = torch.tensor([0.9, 0.9, 0.9])
    _, weight = composite(alpha, torch.ones(3, 1), torch.tensor([0, 3]), early_stop=0.05)
    assert weight.tolist() == pytest.approx([0.9, 0.09, 0.0])
