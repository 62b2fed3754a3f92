"""What the sampling of dense and of sparse grids shares.

A grid here is an object of the extension: its lattice in the world, and in which rows its nodes
are stored.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from univoxel.ops import native

Outputs = tuple[Tensor, Tensor, Tensor, Tensor]
Grads = tuple[Tensor | None, Tensor | None, Tensor | None]


def check_place(op: str, points: int, origin: Sequence[float], voxel_size: float) -> None:
    """Check how many points are sampled, and where the grid lies.

    Raises:
        ValueError: a number out of range.
    """
    if points >= 2**31:
        raise ValueError(f"{op}: points must be fewer than 2^31, got {points}")
    if len(origin) != 3 or not all(math.isfinite(x) for x in origin):
        raise ValueError(f"{op}: origin must be 3 finite numbers, got {list(origin)}")
    if not 0 < voxel_size < math.inf:
        raise ValueError(f"{op}: voxel_size must be above 0, got {voxel_size}")


class SparseGrad(torch.autograd.Function):
    """The same values with a gradient that is sparse in its first dimensions: for backends whose
    own gradient is dense."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, dims: int) -> Tensor:
        ctx.dims = dims
        return values.view_as(values)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return grad.to_sparse(ctx.dims), None


def empty_outputs(features: Tensor, points: Tensor) -> Outputs:
    """Value, gradient, feature, and the points' order by tile, which backward uses again."""
    m = len(points)
    return (
        points.new_empty(m),
        points.new_empty(m, 3),
        features.new_empty(m, features.shape[-1]),
        points.new_empty(m, dtype=torch.int32),
    )


def empty_grads(
    sdf: Tensor, features: Tensor, points: Tensor, needs: list[bool]
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients to fill; one that nobody needs is empty, because an op cannot return None."""
    grads = [
        torch.empty_like(t) if need else t.new_empty(0)
        for t, need in zip((sdf, features, points), needs, strict=True)
    ]
    return grads[0], grads[1], grads[2]


def sample(grid: Any, sdf: Tensor, features: Tensor, points: Tensor) -> Outputs:
    """`empty_outputs`, filled."""
    out = empty_outputs(features, points)
    value, gradient, feature, order = out
    native.require().sample_grid_forward(
        grid,
        *native.arrays(sdf, features, points, order, value, gradient, feature),
        native.threads(),
    )
    return out


def sample_backward(
    grid: Any,
    inputs: tuple[Tensor, Tensor, Tensor, Tensor],  # sdf, features, points, order
    grad_outputs: tuple[Tensor, Tensor, Tensor],  # of value, gradient, feature
    needs: list[bool],
) -> tuple[Tensor, Tensor, Tensor]:
    """`empty_grads`, filled, in the shapes of sdf, features and points."""
    grads = empty_grads(*inputs[:3], needs)
    into = [g if need else None for g, need in zip(grads, needs, strict=True)]
    _backward_into(grid, inputs, grad_outputs, into, (None, None))
    return grads


def sample_backward_sparse(
    grid: Any,
    inputs: tuple[Tensor, Tensor, Tensor, Tensor],
    grad_outputs: tuple[Tensor, Tensor, Tensor],
    needs: list[bool],
) -> Grads:
    """The same into touched rows; no op: how many there are depends on data."""
    sdf, features, points, order = inputs
    core, threads = native.require(), native.threads()
    rows = core.touched_rows(grid, *native.arrays(points, order), sdf.numel(), *needs[:2], threads)
    values = [
        None if r is None else t.new_empty(len(r), *t.shape[sdf.dim() :])
        for r, t in zip(rows, (sdf, features), strict=True)
    ]
    grad_points = torch.empty_like(points) if needs[2] else None
    _backward_into(grid, inputs, grad_outputs, [*values, grad_points], rows)
    grads = [
        None if v is None else _sparse_tensor(r, v, t.shape, sdf.dim())
        for r, v, t in zip(rows, values, (sdf, features), strict=True)
    ]
    return grads[0], grads[1], grad_points


def _backward_into(
    grid: Any,
    inputs: tuple[Tensor, ...],
    grad_outputs: tuple[Tensor, ...],
    grads: list[Tensor | None],  # of sdf, features, points; None: not needed
    rows: tuple[Any, Any],  # that the gradients of sdf and features hold; None: all
) -> None:
    native.require().sample_grid_backward(
        grid,
        *native.arrays(*inputs, *grad_outputs),
        *[None if g is None else g.numpy() for g in grads],
        *rows,
        native.threads(),
    )


def _sparse_tensor(rows: Any, values: Tensor, shape: torch.Size, dims: int) -> Tensor:
    """Values of touched rows as a tensor that is sparse in its first dimensions."""
    indices = torch.empty(dims, len(rows), dtype=torch.int64)
    rows.write(indices.numpy(), native.threads())
    # The rows are distinct, in order and inside by construction: checking costs more than they do.
    return torch.sparse_coo_tensor(
        indices, values, shape, is_coalesced=True, check_invariants=False
    )
