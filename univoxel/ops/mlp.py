"""A small network: linear layers with ReLU between them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from univoxel.ops import native
from univoxel.ops.checks import check


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


@native.operator("mlp")
def _mlp(x: Tensor, weights: list[Tensor], biases: list[Tensor]) -> Tensor:
    out = x.new_empty(len(x), len(biases[-1]))
    native.require().mlp_forward(
        x.detach().numpy(),
        native.arrays(*weights),
        native.arrays(*biases),
        out.numpy(),
        native.threads(),
    )
    return out


@native.operator("mlp_backward")
def _mlp_backward(
    x: Tensor,
    weights: list[Tensor],
    biases: list[Tensor],
    grad_out: Tensor,
    need_x: bool,
    need_layers: bool,
) -> list[Tensor]:
    grads = _empty_grads(x, weights, biases, need_x, need_layers)
    grad_x, *of_layers = native.arrays(*grads)
    native.require().mlp_backward(
        x.detach().numpy(),
        native.arrays(*weights),
        native.arrays(*biases),
        grad_out.numpy(),
        grad_x if need_x else None,
        of_layers[: len(weights)],
        of_layers[len(weights) :],
        native.threads(),
    )
    return grads


def _empty_grads(
    x: Tensor, weights: list[Tensor], biases: list[Tensor], need_x: bool, need_layers: bool
) -> list[Tensor]:
    """Gradients to fill: x, then weights and biases if needed; an op cannot return None."""
    grad_x = torch.empty_like(x) if need_x else x.new_empty(0)
    return [grad_x, *(torch.empty_like(t) for t in (*weights, *biases) if need_layers)]


@_mlp.register_fake
def _(x, weights, biases):
    return x.new_empty(len(x), len(biases[-1]))


@_mlp_backward.register_fake
def _(x, weights, biases, grad_out, need_x, need_layers):
    return _empty_grads(x, weights, biases, need_x, need_layers)


def _save(ctx, inputs, output):
    x, weights, biases = inputs
    ctx.layers = len(weights)
    ctx.save_for_backward(x, *weights, *biases)


def _backward(ctx, grad_out):
    x, *layers = ctx.saved_tensors
    weights, biases = layers[: ctx.layers], layers[ctx.layers :]
    need_x, need_weights, need_biases = ctx.needs_input_grad
    need_layers = any([*need_weights, *need_biases])
    grads = _mlp_backward(x, weights, biases, grad_out.contiguous(), need_x, need_layers)
    none = [None] * ctx.layers
    return (
        grads[0] if need_x else None,
        grads[1 : 1 + ctx.layers] if need_layers else none,
        grads[1 + ctx.layers :] if need_layers else none,
    )


class _Layers(torch.autograd.Function):
    """The op with its layers one by one: weights, then biases."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, layers: int, *parameters: Tensor) -> Tensor:
        ctx.layers = layers
        ctx.save_for_backward(x, *parameters)
        return _mlp.kernel(x, parameters[:layers], parameters[layers:])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_out: Tensor) -> tuple[Tensor | None, ...]:
        x, *parameters = ctx.saved_tensors
        layers = parameters[: ctx.layers], parameters[ctx.layers :]
        need_x, _, *need = ctx.needs_input_grad
        grads = _mlp_backward(x, *layers, grad_out.contiguous(), need_x, any(need))
        none = [None] * len(parameters)
        return grads[0] if need_x else None, None, *(grads[1:] if any(need) else none)


def _direct(x: Tensor, weights: list[Tensor], biases: list[Tensor]) -> Tensor:
    return _Layers.apply(x, len(weights), *weights, *biases)


_mlp.register_autograd(_backward, setup_context=_save, direct=_direct)
