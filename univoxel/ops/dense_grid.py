"""Sampling of a dense grid: distance, its spatial gradient and features at points."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from univoxel.ops import grid_sampling, native
from univoxel.ops.checks import check
from univoxel.ops.grid_sampling import SparseGrad, check_place


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
            grid_sampling.no_table(sdf),
            points.contiguous(),
            list(sdf.shape),
            [float(x) for x in origin],
            float(voxel_size),
            sparse_grad,
        )[:3]
    if sparse_grad:
        sdf, features = SparseGrad.apply(sdf, 3), SparseGrad.apply(features, 3)
    return sample_dense_reference(sdf, features, points, origin, voxel_size)


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


_sample_dense = grid_sampling.sampler("sample_dense")
