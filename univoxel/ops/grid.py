"""Sampling of dense grids, and of sparse grids stored in bricks: distance, its spatial gradient and
features at points."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from univoxel.core.records import Bricks
from univoxel.ops import native
from univoxel.ops.differentiable import check, check_numbers, differentiable

# What the sampling of dense and of sparse grids shares.
#
# A grid here is an object of the extension: its lattice in the world, and in which rows its nodes
# are stored.


def check_place(op: str, points: int, origin: Sequence[float], voxel_size: float) -> None:
    """Check how many points are sampled, and where the grid lies.

    Raises:
        ValueError: a number out of range.
    """
    if points >= 2**31:
        raise ValueError(f"{op}: points must be fewer than 2^31, got {points}")
    if len(origin) != 3 or not all(math.isfinite(x) for x in origin):
        raise ValueError(f"{op}: origin must be 3 finite numbers, got {list(origin)}")
    check_numbers(op, "above 0", voxel_size=voxel_size)


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
    """Gradients to sdf, features and points; None if not needed.

    Args:
        sparse: those to sdf and features hold touched rows only.
    """
    sdf, features, points, order = inputs
    rows = None, None
    if sparse:
        rows = native.call("touched_rows", grid, points, order, sdf.numel(), *needs[:2])
    into = [
        None
        if not need
        else torch.empty_like(t)
        if r is None
        else t.new_empty(len(r), *t.shape[sdf.dim() :])
        for t, r, need in zip((sdf, features, points), (*rows, None), needs, strict=True)
    ]
    native.call("sample_grid_backward", grid, *inputs, *grad_outputs, *into, *rows)
    return [
        g if g is None or r is None else _sparse_tensor(r, g, t.shape, sdf.dim())
        for g, r, t in zip(into, (*rows, None), (sdf, features, points), strict=True)
    ]


def _sparse_tensor(rows: Any, values: Tensor, shape: torch.Size, dims: int) -> Tensor:
    """Values of touched rows as a tensor that is sparse in its first dimensions."""
    indices = torch.empty(dims, len(rows), dtype=torch.int64)
    native.call(rows.write, indices)
    # The rows are distinct, in order and inside by construction: checking costs more than they do.
    return torch.sparse_coo_tensor(
        indices, values, shape, is_coalesced=True, check_invariants=False
    )


def _forward(tensors: Sequence, options: Sequence, outputs: Sequence[Tensor]) -> None:
    sdf, features, table, points = tensors
    value, gradient, feature, order = outputs
    grid, filled = grid_of(table, *options[:3]), (order, value, gradient, feature)
    native.call("sample_grid_forward", grid, sdf, features, points, *filled)


def _backward(
    saved: Sequence, grads: Sequence[Tensor], options: Sequence, needs: list[bool]
) -> list[Tensor | None]:
    sdf, features, table, points, order = saved
    *place, sparse = options
    return gradients(grid_of(table, *place), (sdf, features, points, order), grads, needs, sparse)


@differentiable(
    "sdf* features* table points*",
    "int[] size, float[] origin, float voxel_size, bool sparse_grad",
    outputs=4,
    forward=_forward,
    backward=_backward,
    held=1,
)
def _sample_grid(sdf, features, table, points, *_):
    """Value, gradient, feature, and the points' order by tile, which backward uses again."""
    m = len(points)
    return (
        points.new_empty(m),
        points.new_empty(m, 3),
        features.new_empty(m, features.shape[-1]),
        points.new_empty(m, dtype=torch.int32),
    )


# Sampling of a dense grid: distance, its spatial gradient and features at points.


def sample_dense(
    sdf: Tensor,  # [X, Y, Z]
    features: Tensor,  # [X, Y, Z, C]
    points: Tensor,  # [M, 3]
    origin: Sequence[float],
    voxel_size: float,
    sparse_grad: bool = False,
) -> tuple[Tensor, Tensor, Tensor]:
    """Sample a grid of distances and features at points of the world.

    Node (i, j, k) lies at origin + voxel_size * (i, j, k). With F the trilinear interpolant of the
    sdf and h the voxel size,

        value = F(p),   gradient_x = (F(p + h x) - F(p - h x)) / (2 h),   y and z likewise,

    and feature is the trilinear interpolant of the features. The gradient is continuous across
    cells, unlike the derivative of F, and is the trilinear interpolant of the nodes' central
    differences.

    A point outside the grid is first moved to the nearest point on its border; along an axis on
    which it moved, derivatives with respect to the point are 0. Outside, F has its border values,
    so the central difference at the border is (f_1 - f_0) / (2 h), half of the one-sided one. A NaN
    point yields NaN and contributes to no gradient.

    Args:
        sdf: [X, Y, Z] one distance per node, world units.
        features: [X, Y, Z, C] any number of channels, including 0.
        points: [M, 3] world, fewer than 2^31.
        origin: world position of node (0, 0, 0): 3 finite numbers.
        voxel_size: h, world units, above 0.
        sparse_grad: return gradients of sdf and features as coalesced ``sparse_coo`` tensors that
            contain only the touched rows, as ``RowAdam`` takes them. This is cheap if points touch
            few of many nodes. The gradient reaches further, so the rows of the two differ. Eager
            only: under torch.compile, use dense gradients.

    Returns:
        value [M], world units; gradient [M, 3], no unit; feature [M, C].

    Raises:
        TypeError, ValueError: an argument is no tensor, or of another size, dtype or device than
            above; the grid has no nodes; origin or voxel_size out of range.

    Differentiable in: sdf, features, points (the derivatives of the outputs as defined above: that
    of the gradient is piecewise constant along each axis). Second order raises.
    Source: the lookup of Wu et al. 2022 (Voxurf, "grid_sampler"): gradients from neighbouring
    voxels, interpolated.
    """
    sizes = check(
        "sample_dense", sdf=(sdf, "X Y Z"), features=(features, "X Y Z C"), points=(points, "M 3")
    )
    if not sdf.numel():
        raise ValueError(f"sample_dense: sdf must not be empty, got {list(sdf.shape)}")
    check_place("sample_dense", sizes["M"], origin, voxel_size)
    if native.serves(sdf):
        tensors = (t.contiguous() for t in (sdf, features, no_table(sdf), points))
        place = list(sdf.shape), [float(x) for x in origin], float(voxel_size)
        return _sample_grid(*tensors, *place, sparse_grad)[:3]
    if sparse_grad:
        sdf, features = SparseGrad.apply(sdf, 3), SparseGrad.apply(features, 3)
    return sample_dense_reference(sdf, features, points, origin, voxel_size)


def sample_dense_reference(
    sdf: Tensor, features: Tensor, points: Tensor, origin: Sequence[float], voxel_size: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Reference in eager PyTorch: eight corners, each with its six neighbours."""
    size = torch.tensor(sdf.shape, device=sdf.device)
    lost = points.isnan().any(1, keepdim=True)
    start = torch.tensor(origin, dtype=torch.float64, device=sdf.device)
    # Locate in double, so that a float32 point far from the origin keeps its fraction.
    at = (torch.where(lost, 0.0, points).double() - start) * (1 / voxel_size)
    at = torch.minimum(at.clamp_min(0.0), (size - 1).double())
    cell = torch.minimum(at.detach().long(), (size - 2).clamp_min(0))
    t = (at - cell).to(points.dtype)
    value = torch.zeros_like(points[:, 0])
    gradient = torch.zeros_like(points)
    feature = features.new_zeros(len(points), features.shape[3])
    shifts = torch.eye(3, dtype=torch.long, device=sdf.device)
    for corner in torch.cartesian_prod(*[torch.arange(2, device=sdf.device)] * 3):
        weight = torch.where(corner == 1, t, 1 - t).prod(1)
        node = torch.minimum(cell + corner, size - 1)
        value = value + weight * sdf[node.unbind(1)]
        feature = feature + weight[:, None] * features[node.unbind(1)]
        ahead = [sdf[torch.minimum(node + d, size - 1).unbind(1)] for d in shifts]
        behind = [sdf[(node - d).clamp_min(0).unbind(1)] for d in shifts]
        slope = (torch.stack(ahead, 1) - torch.stack(behind, 1)) / (2 * voxel_size)
        gradient = gradient + weight[:, None] * slope
    value = torch.where(lost[:, 0], torch.nan, value)
    return value, torch.where(lost, torch.nan, gradient), torch.where(lost, torch.nan, feature)


# Sampling of a grid of which only bricks around a surface are stored.


def sample_sparse(
    sdf: Tensor,  # [R]
    features: Tensor,  # [R, C]
    bricks: Bricks,
    points: Tensor,  # [M, 3]
    origin: Sequence[float],
    voxel_size: float,
    sparse_grad: bool = False,
) -> tuple[Tensor, Tensor, Tensor]:
    """Sample a sparse grid of distances and features at points of the world.

    The result is that of `sample_dense` for the grid [X, Y, Z] that `bricks` describes. Nodes of
    missing bricks have the values of bricks 0 and 1, and get no gradient.

    Args:
        sdf: [R] one distance per row, world units; R = 64 n rows of the bricks.
        features: [R, C] any number of channels, including 0.
        bricks: the rows of the nodes of the grid.
        points: [M, 3] world, fewer than 2^31.
        origin: world position of node (0, 0, 0): 3 finite numbers.
        voxel_size: world units, above 0.
        sparse_grad: as for `sample_dense`, over rows.

    Returns:
        value [M], world units; gradient [M, 3], no unit; feature [M, C].

    Raises:
        TypeError, ValueError: an argument is not a tensor or Bricks, or has another size, dtype or
            device than above; the grid has no nodes; origin or voxel_size out of range.

    Differentiable in: sdf, features, points. Second order raises.
    Source: bricks over a table, as in Museth 2013 (VDB) with one level.
    """
    if bricks is None:
        raise TypeError("sample_sparse: bricks must be of the type Bricks, got NoneType")
    tensors = {"sdf": (sdf, "R"), "features": (features, "R C"), "points": (points, "M 3")}
    sizes = check("sample_sparse", bricks, **tensors)
    if not bricks.table.numel():
        raise ValueError(f"sample_sparse: bricks must not be empty, got size {list(bricks.size)}")
    check_place("sample_sparse", sizes["M"], origin, voxel_size)
    if native.serves(sdf):
        tensors = (t.contiguous() for t in (sdf, features, bricks.table, points))
        place = list(bricks.size), [float(x) for x in origin], float(voxel_size)
        return _sample_grid(*tensors, *place, sparse_grad)[:3]
    if sparse_grad:
        sdf, features = SparseGrad.apply(sdf, 1), SparseGrad.apply(features, 1)
    return sample_sparse_reference(sdf, features, bricks, points, origin, voxel_size)


def sample_sparse_reference(
    sdf: Tensor,
    features: Tensor,
    bricks: Bricks,
    points: Tensor,
    origin: Sequence[float],
    voxel_size: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Reference in eager PyTorch, over the whole grid."""
    rows = bricks.grid_rows()
    stored = rows >= Bricks.MISSING * Bricks.NODES
    whole = torch.where(stored, sdf[rows], sdf.detach()[rows])
    of_nodes = torch.where(stored[..., None], features[rows], features.detach()[rows])
    return sample_dense_reference(whole, of_nodes, points, origin, voxel_size)
