"""Small networks: native against reference, against torch.nn."""

import pytest
import torch
from check_op import check_op

from univoxel.ops import mlp, mlp_reference, use_backend


def network(n, *sizes, seed=0):
    """x, then weights and biases of every layer, flat: check_op differentiates each tensor."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=g, dtype=torch.float64).requires_grad_()

    layers = list(zip(sizes[1:], sizes[:-1], strict=True))
    return normal(n, sizes[0]), *[normal(o, i) for o, i in layers], *[normal(o) for o, _ in layers]


def flat(op):
    """The op with its layers as separate arguments."""

    def call(x, *layers):
        return op(x, layers[: len(layers) // 2], layers[len(layers) // 2 :])

    return call


@pytest.mark.parametrize(
    "case",
    [
        (5, 3, 4, 2),
        (1, 1, 1),
        (3, 2, 7, 5, 3, 1),
        (0, 3, 4, 2),
        (9, 40, 17),  # panels and blocks with a rest, of any instruction set
        (13, 33, 65, 16),
    ],
)
def test_native_equals_reference(case):
    check_op(flat(mlp), flat(mlp_reference), [network(*case)])


@pytest.mark.parametrize("wanted", [[0], [1, 2], [4], []])
def test_gradients_of_some_arguments(wanted):
    inputs = [t.detach().requires_grad_(i in wanted) for i, t in enumerate(network(6, 3, 4, 2))]
    out = flat(mlp)(*inputs)
    assert out.requires_grad == bool(wanted)
    if not wanted:
        return
    out.square().sum().backward()
    with use_backend("reference"):
        expected = torch.autograd.grad(
            flat(mlp)(*inputs).square().sum(), [inputs[i] for i in wanted]
        )
    for i, grad in zip(wanted, expected, strict=True):
        torch.testing.assert_close(inputs[i].grad, grad)
    assert all(t.grad is None for i, t in enumerate(inputs) if i not in wanted)
