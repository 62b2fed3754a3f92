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
from univoxel.ops.differentiable import Differentiable, differentiable


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


def grid_of(table: Tensor, size: list[int], origin: list[float], voxel_size: float) -> Any:
    """The grid as the extension has it; dense where the table of bricks is empty."""
    if table.numel():
        return native.require().SparseGrid(*native.arrays(table), size, origin, voxel_size)
    return native.require().DenseGrid(size, origin, voxel_size)


def no_table(like: Tensor) -> Tensor:
    """The table of a dense grid."""
    return like.new_empty(0, 0, 0, dtype=torch.int32)


def gradients(
    grid: Any,
    inputs: Sequence[Tensor],  # sdf, features, points, order
    grad_outputs: Sequence[Tensor],  # of value, gradient, feature
    needs: list[bool],
    sparse: bool,
) -> list[Tensor | None]:
    """Gradients to sdf, features and points; None where not needed.

    Args:
        sparse: those to sdf and features hold touched rows alone.
    """
    sdf, features, points, order = inputs
    core, threads = native.require(), native.threads()
    rows = None, None
    if sparse:
        touching = native.arrays(points, order)
        rows = core.touched_rows(grid, *touching, sdf.numel(), *needs[:2], threads)
    into = [
        None
        if not need
        else torch.empty_like(t)
        if r is None
        else t.new_empty(len(r), *t.shape[sdf.dim() :])
        for t, r, need in zip((sdf, features, points), (*rows, None), needs, strict=True)
    ]
    core.sample_grid_backward(grid, *native.arrays(*inputs, *grad_outputs, *into), *rows, threads)
    return [
        g if g is None or r is None else _sparse_tensor(r, g, t.shape, sdf.dim())
        for g, r, t in zip(into, (*rows, None), (sdf, features, points), strict=True)
    ]


def _sparse_tensor(rows: Any, values: Tensor, shape: torch.Size, dims: int) -> Tensor:
    """Values of touched rows as a tensor that is sparse in its first dimensions."""
    indices = torch.empty(dims, len(rows), dtype=torch.int64)
    rows.write(indices.numpy(), native.threads())
    # The rows are distinct, in order and inside by construction: checking costs more than they do.
    return torch.sparse_coo_tensor(
        indices, values, shape, is_coalesced=True, check_invariants=False
    )


def _forward(tensors: Sequence, options: Sequence, outputs: Sequence[Tensor]) -> None:
    sdf, features, table, points = tensors
    value, gradient, feature, order = outputs
    native.require().sample_grid_forward(
        grid_of(table, *options[:3]),
        *native.arrays(sdf, features, points, order, value, gradient, feature),
        native.threads(),
    )


def _backward(
    saved: Sequence, grads: Sequence[Tensor], options: Sequence, needs: list[bool]
) -> list[Tensor | None]:
    sdf, features, table, points, order = saved
    *place, sparse = options
    return gradients(grid_of(table, *place), (sdf, features, points, order), grads, needs, sparse)


def _sampled(
    sdf: Tensor,
    features: Tensor,
    table: Tensor,
    points: Tensor,
    size: list[int],
    origin: list[float],
    voxel_size: float,
    sparse_grad: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Value, gradient, feature, and the points' order by tile, which backward uses again."""
    m = len(points)
    return (
        points.new_empty(m),
        points.new_empty(m, 3),
        features.new_empty(m, features.shape[-1]),
        points.new_empty(m, dtype=torch.int32),
    )


def sampler(name: str) -> Differentiable:
    """The op of that name. It is the same for both: a dense grid is one without a table."""
    to = "sdf features points"
    return differentiable(to, name=name, forward=_forward, backward=_backward, held=1)(_sampled)
