"""Grids of cubic voxels in the world: where their nodes lie, and resampling between them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from univoxel.core.validation import check_fields

MOST = 1 << 31  # nodes: files and kernels number them by int32


@dataclass(frozen=True)
class GridShape:
    """A grid of cubic voxels in the world; node (i, j, k) lies at origin + voxel_size (i, j, k)."""

    origin: tuple[float, float, float]
    voxel_size: float
    size: tuple[int, int, int]  # nodes, >= 2 along each axis, below 2^31 in all

    def __post_init__(self) -> None:
        check_fields(self, "above 0", lambda x: 0 < x < math.inf, "voxel_size")
        check_fields(self, "finite", lambda x: all(map(math.isfinite, x)), "origin")
        check_fields(
            self,
            "at least 2 along each axis and below 2^31 in all",
            lambda x: min(x) > 1 and math.prod(x) < MOST,
            "size",
        )

    @property
    def nodes_count(self) -> int:
        x, y, z = self.size
        return x * y * z

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lower and upper corner [3], [3] of the box of the nodes, world units."""
        lower = torch.tensor(self.origin)
        return lower, lower + self.voxel_size * (torch.tensor(self.size) - 1)

    def nodes(self) -> Tensor:
        """World positions of the nodes: [X, Y, Z, 3] float32."""
        axes = [
            o + self.voxel_size * torch.arange(n)
            for o, n in zip(self.origin, self.size, strict=True)
        ]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)


def fit_grid(lower: Tensor, upper: Tensor, voxels: int) -> GridShape:
    """A grid over the box [lower, upper] with about this many voxels."""
    extent = (upper - lower).double().clamp_min(1e-9)
    voxel_size = float((extent.prod() / voxels) ** (1 / 3))
    cells = (extent / voxel_size).ceil().clamp_min(2)
    origin = (lower + upper).double() / 2 - cells * voxel_size / 2
    x, y, z = (int(c) + 1 for c in cells.tolist())
    return GridShape(tuple(origin.tolist()), voxel_size, (x, y, z))


def fit_coarse(grid: GridShape, stride: int) -> GridShape:
    """A grid from the same origin with voxels `stride` times as wide that covers the same box."""
    x, y, z = (-(-(n - 1) // stride) + 1 for n in grid.size)
    return GridShape(grid.origin, grid.voxel_size * stride, (x, y, z))


def resample(values: Tensor, source: GridShape, target: GridShape) -> Tensor:
    """Trilinear resampling between grids: [X, Y, Z] or [X, Y, Z, C], clamped at the border."""
    start = torch.tensor(target.origin) - torch.tensor(source.origin)
    axes = []
    for a in range(3):
        g = (start[a] + target.voxel_size * torch.arange(target.size[a])) / source.voxel_size
        axes.append(2 * g / max(source.size[a] - 1, 1) - 1)
    where = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).flip(-1).to(values.dtype)
    channels_first = values[None] if values.dim() == 3 else values.movedim(-1, 0)
    out = torch.nn.functional.grid_sample(
        channels_first[None], where[None], align_corners=True, padding_mode="border"
    )[0]
    return out[0] if values.dim() == 3 else out.movedim(0, -1).contiguous()
