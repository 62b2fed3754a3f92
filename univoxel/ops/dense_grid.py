"""Sampling of a dense grid: distance, its spatial gradient and features at points."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from univoxel.ops import native
from univoxel.ops.checks import check


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

    A point outside the grid is first moved to the nearest point of its border; along an axis on
    which it moved, derivatives to the point are 0. F itself holds its border values outside, so
    the central difference at the border is (f_1 - f_0) / (2 h): half of the one-sided one. A
    NaN point yields NaN and contributes to no gradient.

    Args:
        sdf: [X, Y, Z] one distance a node, world units.
        features: [X, Y, Z, C] any number of channels, 0 included.
        points: [M, 3] world, fewer than 2^31.
        origin: world position of node (0, 0, 0): 3 finite numbers.
        voxel_size: h, world units, above 0.
        sparse_grad: gradients of sdf and features come back as coalesced ``sparse_coo`` tensors
            that hold only the rows some point touched: cheap where points meet few of many nodes,
            and what ``RowAdam`` takes. The rows of the two differ: the gradient reaches further.
            Eager only: under torch.compile ask for dense gradients.

    Returns:
        value [M], world units; gradient [M, 3], no unit; feature [M, C].

    Raises:
        TypeError, ValueError: an argument is no tensor, or of another size, dtype or device than
            above; the grid has no nodes; origin or voxel_size out of range.

    Differentiable in: sdf, features, points (the derivative of the outputs as defined: the
    gradient's derivative is piecewise constant along each axis). Second order raises.
    Source: the lookup of Wu et al. 2022 (Voxurf, "grid_sampler"): gradients from neighbouring
    voxels, interpolated.
    """
    sizes = check(
        "sample_dense",
        sdf=(sdf, "X Y Z"),
        features=(features, "X Y Z C"),
        points=(points, "M 3"),
    )
    if not sdf.numel():
        raise ValueError(f"sample_dense: sdf must have nodes, got {list(sdf.shape)}")
    check_place("sample_dense", sizes["M"], origin, voxel_size)
    if native.serves(sdf):
        return _sample_dense(
            sdf.contiguous(),
            features.contiguous(),
            points.contiguous(),
            [float(x) for x in origin],
            float(voxel_size),
            sparse_grad,
        )[:3]
    if sparse_grad:
        sdf, features = SparseGrad.apply(sdf, 3), SparseGrad.apply(features, 3)
    return sample_dense_reference(sdf, features, points, origin, voxel_size)


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


def sample_dense_reference(
    sdf: Tensor, features: Tensor, points: Tensor, origin: Sequence[float], voxel_size: float
) -> tuple[Tensor, Tensor, Tensor]:
    """The same in eager torch: eight corners, each with its six neighbours."""
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


class SparseGrad(torch.autograd.Function):
    """The same grid with a gradient that is sparse in its first dimensions: for backends whose own
    gradient is dense."""

    @staticmethod
    def forward(ctx, grid, dims):
        ctx.dims = dims
        return grid.view_as(grid)

    @staticmethod
    def backward(ctx, grad):
        return grad.to_sparse(ctx.dims), None


@native.operator("sample_dense")
def _sample_dense(
    sdf: Tensor,
    features: Tensor,
    points: Tensor,
    origin: list[float],
    voxel_size: float,
    sparse_grad: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    out = _empty_outputs(features, points)
    value, gradient, feature, order = out
    native.require().sample_dense_forward(
        *native.arrays(sdf, features, points, order, value, gradient, feature),
        origin,
        voxel_size,
        native.threads(),
    )
    return out


def _empty_outputs(features: Tensor, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Value, gradient, feature, and the points' order by brick, which backward uses again."""
    m = len(points)
    return (
        points.new_empty(m),
        points.new_empty(m, 3),
        features.new_empty(m, features.shape[3]),
        points.new_empty(m, dtype=torch.int32),
    )


@native.operator("sample_dense_backward")
def _sample_dense_backward(
    sdf: Tensor,
    features: Tensor,
    points: Tensor,
    order: Tensor,
    grad_value: Tensor,
    grad_gradient: Tensor,
    grad_feature: Tensor,
    origin: list[float],
    voxel_size: float,
    needs: list[bool],
) -> tuple[Tensor, Tensor, Tensor]:
    grads = _empty_grads(sdf, features, points, needs)
    native.require().sample_dense_backward(
        *native.arrays(sdf, features, points, order, grad_value, grad_gradient, grad_feature),
        *[g.numpy() if need else None for g, need in zip(grads, needs, strict=True)],
        None,
        None,
        origin,
        voxel_size,
        native.threads(),
    )
    return grads


def _empty_grads(
    sdf: Tensor, features: Tensor, points: Tensor, needs: list[bool]
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients to fill; one that nobody needs is empty, because an op cannot return None."""
    grads = [
        torch.empty_like(t) if need else t.new_empty(0)
        for t, need in zip((sdf, features, points), needs, strict=True)
    ]
    return grads[0], grads[1], grads[2]


def _sparse_backward(
    sdf: Tensor,
    features: Tensor,
    points: Tensor,
    order: Tensor,
    grad_outputs: list[Tensor],
    origin: list[float],
    voxel_size: float,
    needs: list[bool],
) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
    """The backward of sample_dense into touched rows; no op: how many there are depends on data."""
    core, threads = native.require(), native.threads()
    grids = (sdf, features)
    rows = core.touched_rows(
        *native.arrays(points, order), list(sdf.shape), origin, voxel_size, *needs[:2], threads
    )
    values = [
        None if r is None else g.new_empty(len(r), *g.shape[3:])
        for r, g in zip(rows, grids, strict=True)
    ]
    grad_points = torch.empty_like(points) if needs[2] else None
    core.sample_dense_backward(
        *native.arrays(sdf, features, points, order, *grad_outputs),
        *[None if t is None else t.numpy() for t in (*values, grad_points)],
        *rows,
        origin,
        voxel_size,
        threads,
    )
    grads = [_sparse(r, v, g) for r, v, g in zip(rows, values, grids, strict=True)]
    return grads[0], grads[1], grad_points


def _sparse(rows, values: Tensor | None, grid: Tensor) -> Tensor | None:
    """Values of touched rows as a sparse tensor of the grid's shape."""
    if values is None:
        return None
    indices = torch.empty(3, len(rows), dtype=torch.int64)
    rows.write_indices(indices.numpy(), native.threads())
    # The rows are distinct, in order and inside by construction: checking costs more than they do.
    return torch.sparse_coo_tensor(
        indices, values, grid.shape, is_coalesced=True, check_invariants=False
    )


@_sample_dense.register_fake
def _(sdf, features, points, origin, voxel_size, sparse_grad):
    return _empty_outputs(features, points)


@_sample_dense_backward.register_fake
def _(
    sdf,
    features,
    points,
    order,
    grad_value,
    grad_gradient,
    grad_feature,
    origin,
    voxel_size,
    needs,
):
    return _empty_grads(sdf, features, points, needs)


def _save(ctx, inputs, output):
    sdf, features, points, ctx.origin, ctx.voxel_size, ctx.sparse_grad = inputs
    ctx.save_for_backward(sdf, features, points, output[3])


def _backward(ctx, grad_value, grad_gradient, grad_feature, _):
    grad_outputs = [g.contiguous() for g in (grad_value, grad_gradient, grad_feature)]
    needs = list(ctx.needs_input_grad[:3])
    sdf, features, points, order = ctx.saved_tensors
    saved, place = (sdf, features, points, order), (ctx.origin, ctx.voxel_size, needs)
    if ctx.sparse_grad:
        grads = _sparse_backward(*saved, grad_outputs, *place)
    else:
        dense = _sample_dense_backward(*saved, *grad_outputs, *place)
        grads = [g if need else None for g, need in zip(dense, needs, strict=True)]
    return *grads, None, None, None


_sample_dense.register_autograd(_backward, setup_context=_save)
