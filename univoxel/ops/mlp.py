"""A small network: linear layers with ReLU between them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from univoxel.ops import native
from univoxel.ops.checks import check
from univoxel.ops.differentiable import differentiable


def mlp(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> Tensor:
    """Decode rows by linear layers with ReLU between them.

        h_0 = x,   h_{l+1} = max(h_l W_l^T + b_l, 0),   without the maximum in the last layer

    Args:
        x: [N, A] any number of rows.
        weights: one [out, in] a layer, as of torch.nn.Linear; every size at least 1.
        biases: one [out] a layer.

    Returns:
        [N, Z], Z the last layer's `out`.

    Raises:
        TypeError, ValueError: an argument is no tensor, or of another size, dtype or device than
            above; there is no layer, or weights and biases differ in number.

    Differentiable in: x, weights, biases; at 0 the derivative of ReLU is 0. Second order raises.
    """
    weights, biases = list(weights), list(biases)
    if not weights or len(weights) != len(biases):
        raise ValueError(
            f"mlp: weights and biases must be one for each of the layers, at least one, got "
            f"{len(weights)} and {len(biases)}"
        )
    layers: dict[str, tuple[Tensor, str]] = {}
    for i, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        layers[f"weights[{i}]"] = (weight, f"H{i + 1} H{i}")
        layers[f"biases[{i}]"] = (bias, f"H{i + 1}")
    sizes = check("mlp", x=(x, "N H0"), **layers)
    empty = [name for name, size in sizes.items() if name != "N" and size < 1]
    if empty:
        raise ValueError(f"mlp: every size must be at least 1, got {empty[0]}=0")
    if native.serves(x):
        return _mlp(
            x.contiguous(), [w.contiguous() for w in weights], [b.contiguous() for b in biases]
        )
    return mlp_reference(x, weights, biases)


def mlp_reference(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> Tensor:
    """The same in eager torch."""
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        x = torch.relu(torch.nn.functional.linear(x, weight, bias))
    return torch.nn.functional.linear(x, weights[-1], biases[-1])


def _forward(tensors: Sequence, _: Sequence, outputs: Sequence[Tensor]) -> None:
    x, weights, biases = tensors
    n = len(weights)
    x, *layers, out = native.arrays(x, *weights, *biases, *outputs)
    native.require().mlp_forward(x, layers[:n], layers[n:], out, native.threads())


def _backward(
    saved: Sequence, grads: Sequence[Tensor], _: Sequence, needs: list[bool]
) -> list[Tensor | None]:
    """Gradients to all layers or to none."""
    x, weights, biases = saved
    n, need_x, need_layers = len(weights), needs[0], any(needs[1:])
    of_x = torch.empty_like(x) if need_x else None
    of_layers = [torch.empty_like(t) for t in (*weights, *biases)] if need_layers else []
    x, *layers, grad_out = native.arrays(x, *weights, *biases, *grads)
    into_x, *into = native.arrays(of_x, *of_layers)
    native.require().mlp_backward(
        x, layers[:n], layers[n:], grad_out, into_x, into[:n], into[n:], native.threads()
    )
    return [of_x, *(of_layers or [None] * (2 * n))]


@differentiable(to="x weights biases", forward=_forward, backward=_backward)
def _mlp(x: Tensor, weights: list[Tensor], biases: list[Tensor]) -> Tensor:
    return x.new_empty(len(x), len(biases[-1]))
