"""Sampling of a grid of which only bricks around a surface are stored."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from univoxel.ops import native
from univoxel.ops.checks import check, check_bricks
from univoxel.ops.dense_grid import SparseGrad, check_place, sample_dense_reference
from univoxel.records import Bricks


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

    What `sample_dense` makes of the grid [X, Y, Z] that `bricks` describes. Nodes of missing bricks
    hold what bricks 0 and 1 hold, and get no gradient.

    Args:
        sdf: [R] one distance a row, world units; R = 64 n rows of the bricks.
        features: [R, C] any number of channels, 0 included.
        bricks: where the nodes of the grid lie.
        points: [M, 3] world, fewer than 2^31.
        origin: world position of node (0, 0, 0): 3 finite numbers.
        voxel_size: world units, above 0.
        sparse_grad: as for `sample_dense`, over rows.

    Returns:
        value [M], world units; gradient [M, 3], no unit; feature [M, C].

    Raises:
        TypeError, ValueError: an argument is no tensor or no Bricks, or of another size, dtype or
            device than above; the grid has no nodes; origin or voxel_size out of range.

    Differentiable in: sdf, features, points. Second order raises.
    Source: bricks over a table, as in Museth 2013 (VDB) with one level.
    """
    check_bricks("sample_sparse", bricks, sdf=(sdf, "R"), features=(features, "R C"))
    sizes = check(
        "sample_sparse", sdf=(sdf, "R"), features=(features, "R C"), points=(points, "M 3")
    )
    if not bricks.table.numel():
        raise ValueError(f"sample_sparse: bricks must have nodes, got size {list(bricks.size)}")
    check_place("sample_sparse", sizes["M"], origin, voxel_size)
    if native.serves(sdf):
        return _sample_sparse(
            sdf.contiguous(),
            features.contiguous(),
            bricks.table,
            points.contiguous(),
            list(bricks.size),
            [float(x) for x in origin],
            float(voxel_size),
            sparse_grad,
        )[:3]
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
    """The same in eager torch, over the whole grid."""
    rows = bricks.grid_rows()
    stored = rows >= Bricks.MISSING * Bricks.NODES
    whole = torch.where(stored, sdf[rows], sdf.detach()[rows])
    of_nodes = torch.where(stored[..., None], features[rows], features.detach()[rows])
    return sample_dense_reference(whole, of_nodes, points, origin, voxel_size)


@native.operator("sample_sparse")
def _sample_sparse(
    sdf: Tensor,
    features: Tensor,
    table: Tensor,
    points: Tensor,
    size: list[int],
    origin: list[float],
    voxel_size: float,
    sparse_grad: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    out = _empty_outputs(features, points)
    value, gradient, feature, order = out
    native.require().sample_sparse_forward(
        *native.arrays(sdf, features, points, order, table, value, gradient, feature),
        size,
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
        features.new_empty(m, features.shape[1]),
        points.new_empty(m, dtype=torch.int32),
    )


@native.operator("sample_sparse_backward")
def _sample_sparse_backward(
    sdf: Tensor,
    features: Tensor,
    table: Tensor,
    points: Tensor,
    order: Tensor,
    grad_value: Tensor,
    grad_gradient: Tensor,
    grad_feature: Tensor,
    size: list[int],
    origin: list[float],
    voxel_size: float,
    needs: list[bool],
) -> tuple[Tensor, Tensor, Tensor]:
    grads = _empty_grads(sdf, features, points, needs)
    native.require().sample_sparse_backward(
        *native.arrays(
            sdf, features, points, order, table, grad_value, grad_gradient, grad_feature
        ),
        *[g.numpy() if need else None for g, need in zip(grads, needs, strict=True)],
        None,
        None,
        size,
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


def _into_touched_rows(
    sdf: Tensor,
    features: Tensor,
    table: Tensor,
    points: Tensor,
    order: Tensor,
    grad_outputs: list[Tensor],
    size: list[int],
    origin: list[float],
    voxel_size: float,
    needs: list[bool],
) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
    """The backward into touched rows; no op: how many there are depends on data."""
    core, threads = native.require(), native.threads()
    pools = (sdf, features)
    touched = core.touched_brick_rows(
        *native.arrays(points, order, table),
        len(sdf),
        size,
        origin,
        voxel_size,
        *needs[:2],
        threads,
    )
    values = [
        None if t is None else p.new_empty(len(t), *p.shape[1:])
        for t, p in zip(touched, pools, strict=True)
    ]
    grad_points = torch.empty_like(points) if needs[2] else None
    core.sample_sparse_backward(
        *native.arrays(sdf, features, points, order, table, *grad_outputs),
        *[None if t is None else t.numpy() for t in (*values, grad_points)],
        *touched,
        size,
        origin,
        voxel_size,
        threads,
    )
    grads = [_sparse(t, v, p) for t, v, p in zip(touched, values, pools, strict=True)]
    return grads[0], grads[1], grad_points


def _sparse(touched, values: Tensor | None, pool: Tensor) -> Tensor | None:
    """Values of touched rows as a sparse tensor of the pool's shape."""
    if values is None:
        return None
    rows = torch.empty(1, len(touched), dtype=torch.int64)
    touched.write_rows(rows.numpy(), native.threads())
    # The rows are distinct, in order and inside by construction: checking costs more than they do.
    return torch.sparse_coo_tensor(
        rows, values, pool.shape, is_coalesced=True, check_invariants=False
    )


@_sample_sparse.register_fake
def _(sdf, features, table, points, size, origin, voxel_size, sparse_grad):
    return _empty_outputs(features, points)


@_sample_sparse_backward.register_fake
def _(
    sdf,
    features,
    table,
    points,
    order,
    grad_value,
    grad_gradient,
    grad_feature,
    size,
    origin,
    voxel_size,
    needs,
):
    return _empty_grads(sdf, features, points, needs)


def _save(ctx, inputs, output):
    sdf, features, table, points, ctx.size, ctx.origin, ctx.voxel_size, ctx.sparse_grad = inputs
    ctx.save_for_backward(sdf, features, table, points, output[3])


def _backward(ctx, grad_value, grad_gradient, grad_feature, _):
    grad_outputs = [g.contiguous() for g in (grad_value, grad_gradient, grad_feature)]
    needs = [ctx.needs_input_grad[i] for i in (0, 1, 3)]
    sdf, features, table, points, order = ctx.saved_tensors
    saved = (sdf, features, table, points, order)
    place = (ctx.size, ctx.origin, ctx.voxel_size, needs)
    if ctx.sparse_grad:
        grads = _into_touched_rows(*saved, grad_outputs, *place)
    else:
        filled = _sample_sparse_backward(*saved, *grad_outputs, *place)
        grads = [g if need else None for g, need in zip(filled, needs, strict=True)]
    return grads[0], grads[1], None, grads[2], None, None, None, None


_sample_sparse.register_autograd(_backward, setup_context=_save)
