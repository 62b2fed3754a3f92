"""Sampling of a grid of which only bricks around a surface are stored."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from univoxel.ops import grid_sampling, native
from univoxel.ops.checks import check, check_bricks
from univoxel.ops.dense_grid import sample_dense_reference
from univoxel.ops.grid_sampling import SparseGrad, check_place
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


_sample_sparse = grid_sampling.sampler("sample_sparse")
