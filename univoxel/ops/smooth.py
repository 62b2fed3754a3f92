"""Smoothing of the grid rows that an optimiser step updates, and of their gradients."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from univoxel.core.records import Bricks
from univoxel.ops import native
from univoxel.ops.differentiable import check, check_numbers


@torch.no_grad()
def smooth_rows_(
    grid: Tensor, rows: Tensor, amount: float, order: int, bricks: Bricks | None = None
) -> Tensor:
    """Smooth the chosen nodes of a grid in place, all from their previous values.

        order 1:  f += amount L f      diffusion towards the mean of the neighbours
        order 2:  f -= amount L L f    thin plate: linear functions, such as a flat SDF, stay

    with L f = mean of the six neighbours - f; at the border, the nearest node is repeated. It is
    meant as a regulariser beside the optimiser, like decoupled weight decay (Loshchilov and Hutter
    2019).

    Args:
        grid: [X, Y, Z, C] contiguous; with bricks [64 n, C].
        rows: [K] int64 flat node indices ((x Y) + y) Z + z, without repeats; with bricks, rows of
            bricks in use. Ascending order is fastest.
        amount: in [0, 1]; order 2 is stable up to 0.5.
        order: 1 or 2.
        bricks: of a sparse grid. Missing neighbours have the values of bricks 0 and 1.

    Returns:
        grid.

    Raises:
        TypeError, ValueError: an argument has another size, dtype, device or range than above.
    """
    of_grid = "X Y Z C" if bricks is None else "R C"
    check("smooth_rows_", bricks, grid=(grid, of_grid), rows=(rows, "K", torch.int64))
    if order not in (1, 2):
        raise ValueError(f"smooth_rows_: order must be 1 or 2, got {order}")
    check_numbers("smooth_rows_", "in [0, 1]", amount=amount)
    if not grid.is_contiguous():
        raise ValueError("smooth_rows_: grid is changed in place, so it must be contiguous")
    if not native.serves(grid):
        return smooth_rows_reference_(grid, rows, amount, order, bricks)
    rest = rows.contiguous(), float(amount), order
    if bricks is None:
        native.call("smooth_rows", grid, *rest)
    else:
        native.call("smooth_brick_rows", grid, bricks.table, bricks.place, bricks.size, *rest)
    return grid


@torch.no_grad()
def smooth_rows_reference_(
    grid: Tensor, rows: Tensor, amount: float, order: int, bricks: Bricks | None = None
) -> Tensor:
    """Reference in eager PyTorch, over the whole grid."""
    if bricks is not None:
        node = bricks.grid_rows()
        smoothed = smooth_rows_reference_(grid[node], torch.arange(node.numel()), amount, order)
        chosen = torch.zeros(len(grid), dtype=torch.bool).index_fill_(0, rows, True)[node]
        grid[node[chosen]] = smoothed[chosen]
        return grid
    change = _laplacian(grid) if order == 1 else -_laplacian(_laplacian(grid))
    flat = grid.view(-1, grid.shape[-1])
    flat[rows] += amount * change.reshape(flat.shape)[rows]
    return grid


@torch.no_grad()
def diffuse_rows_(
    values: Tensor,
    rows: Tensor,
    size: Sequence[int],
    amount: float,
    passes: int,
    bricks: Bricks | None = None,
) -> Tensor:
    """Diffuse values in place among the chosen nodes of a grid that is 0 elsewhere.

        f += amount L f, passes times; L as in `smooth_rows_`, f = 0 at nodes that are not in rows

    Apply it to a gradient before the optimiser's step, so that neighbours move alike and a surface
    moves in large pieces (a Sobolev gradient, as in Nicolet et al. 2021, Large Steps in Inverse
    Rendering of Geometry).

    Args:
        values: [K] contiguous.
        rows: [K] int64 ascending flat node indices ((x Y) + y) Z + z; with bricks, rows of bricks
            in use.
        size: [X, Y, Z] of the grid.
        amount: in [0, 1].
        passes: at least 0.
        bricks: of a sparse grid.

    Returns:
        values.

    Raises:
        TypeError, ValueError: an argument has another size, dtype, device or range than above.
    """
    check("diffuse_rows_", values=(values, "K"), rows=(rows, "K", torch.int64))
    check_numbers("diffuse_rows_", "in [0, 1]", amount=amount)
    check_numbers("diffuse_rows_", "at least 0", passes=passes)
    if len(size) != 3 or (bricks is not None and tuple(size) != tuple(bricks.size)):
        raise ValueError(f"diffuse_rows_: size must be the size [X, Y, Z] of the grid, got {size}")
    if not values.is_contiguous():
        raise ValueError("diffuse_rows_: values are changed in place, so they must be contiguous")
    if not native.serves(values):
        return diffuse_rows_reference_(values, rows, size, amount, passes, bricks)
    rest = list(size), rows.contiguous(), float(amount), int(passes)
    if bricks is None:
        native.call("diffuse_rows", values, *rest)
    else:
        native.call("diffuse_brick_rows", values, bricks.table, bricks.place, *rest)
    return values


@torch.no_grad()
def diffuse_rows_reference_(
    values: Tensor,
    rows: Tensor,
    size: Sequence[int],
    amount: float,
    passes: int,
    bricks: Bricks | None = None,
) -> Tensor:
    """Reference in eager PyTorch, over the whole grid."""
    n = torch.Size(size).numel() if bricks is None else bricks.place.numel() * Bricks.NODES
    shape = (*size, 1) if bricks is None else (n, 1)
    grid = values.new_zeros(n).index_copy_(0, rows, values).view(shape)
    for _ in range(passes):
        smooth_rows_reference_(grid, rows, amount, 1, bricks)
    return values.copy_(grid.view(-1)[rows])


def _laplacian(grid: Tensor) -> Tensor:
    total = -6 * grid
    for axis in range(3):
        n = grid.shape[axis]
        at = torch.arange(n, device=grid.device)
        for by in (-1, 1):
            total = total + grid.index_select(axis, (at + by).clamp(0, n - 1))
    return total / 6
