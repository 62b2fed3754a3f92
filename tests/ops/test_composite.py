"""Compositing: native against reference, closed forms, bad arguments."""

import pytest
import torch
from check_op import check_op

from univoxel.ops import composite, composite_reference
from univoxel.ops.composite import _composite


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


def test_opcheck():
    torch.library.opcheck(_composite.defined, (*rays([3, 0, 4]), 0.1))


def test_many_rays_cross_the_chunks():
    alpha, value, offsets = rays([3] * 1000)
    out, weight = composite(alpha, value, offsets)
    expected, expected_weight = composite_reference(alpha, value, offsets)
    torch.testing.assert_close(out, expected)
    torch.testing.assert_close(weight, expected_weight)


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


def test_whole_graph_compiles():
    alpha, value, offsets = rays([3, 5])

    @torch.compile(fullgraph=True)
    def loss(alpha, value):
        return composite(alpha, value, offsets)[0].square().sum()

    loss(alpha, value).backward()
    expected = torch.autograd.grad(
        composite_reference(alpha, value, offsets)[0].square().sum(), [alpha, value]
    )
    torch.testing.assert_close([alpha.grad, value.grad], list(expected))


def test_strided_inputs():
    alpha, value, offsets = rays([3, 4])
    strided = value.repeat(1, 2)[:, ::2]
    assert not strided.is_contiguous()
    torch.testing.assert_close(
        composite(alpha, strided, offsets), composite_reference(alpha, strided, offsets)
    )


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"alpha": torch.rand(7, 1)}, ValueError, r"alpha must be \[M\]"),
        ({"alpha": torch.arange(7)}, ValueError, "alpha must be .* floating .* got .* int64"),
        ({"alpha": [0.5] * 7}, TypeError, "alpha must be a tensor, got list"),
        ({"value": torch.rand(6, 3)}, ValueError, r"value must be \[M, C\] .* M=7"),
        ({"value": torch.rand(7, 3).double()}, ValueError, "value must be .* float32"),
        ({"value": torch.rand(7, 3, device="meta")}, ValueError, "value must be .* on cpu"),
        ({"offsets": torch.tensor([0, 3, 7], dtype=torch.int32)}, ValueError, "int64"),
        ({"offsets": torch.tensor([0, 5, 3, 7])}, ValueError, "offsets must rise from 0"),
        ({"offsets": torch.tensor([0, 3, 6])}, ValueError, "offsets must rise from 0"),
        ({"offsets": torch.tensor([], dtype=torch.int64)}, ValueError, "offsets must be"),
        ({"early_stop": 1.5}, ValueError, r"early_stop must be in \[0, 1\], got 1.5"),
    ],
)
def test_bad_arguments(change, error, message):
    arguments = {
        "alpha": torch.rand(7),
        "value": torch.rand(7, 3),
        "offsets": torch.tensor([0, 3, 7]),
    }
    composite(**arguments)
    with pytest.raises(error, match=message):
        composite(**(arguments | change))
