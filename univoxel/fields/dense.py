"""A dense grid: one signed distance and C features at every node."""

from __future__ import annotations

import torch
from skimage.measure import marching_cubes
from torch import Tensor, nn

from univoxel.errors import NoSurface
from univoxel.fields.base import AbstractField
from univoxel.grid import GridShape, resample
from univoxel.ops import brick_minimum, diffuse_rows_, march, sample_dense, smooth_rows_
from univoxel.records import FieldSample, Rays, Samples


class DenseField(AbstractField):
    """SDF [X, Y, Z] and features [X, Y, Z, C] as parameters."""

    kind = "dense"

    def __init__(self, grid: GridShape, channels: int, sdf: Tensor | None = None):
        super().__init__()
        self.grid, self.channels, self.voxel_size = grid, channels, grid.voxel_size
        start = torch.zeros(grid.size) if sdf is None else sdf
        self.sdf = nn.Parameter(start.contiguous())
        self.features = nn.Parameter(torch.zeros(*grid.size, channels))
        self._brick_min: Tensor | None = None

    def sample(self, points: Tensor) -> FieldSample:
        return self._sample(self.sdf, points)

    def features_at(self, points: Tensor) -> Tensor:
        return self._sample(self.sdf.detach(), points).features

    def _sample(self, sdf: Tensor, points: Tensor) -> FieldSample:
        place = self.grid.origin, self.voxel_size
        return FieldSample(*sample_dense(sdf, self.features, points, *place, sparse_grad=True))

    def march(self, rays: Rays, jitter: Tensor, inv_s: float) -> Samples:
        if self._brick_min is None:
            self._brick_min = brick_minimum(self.sdf.detach())
        return march(
            self.sdf.detach(),
            self._brick_min,
            rays.origin,
            rays.direction,
            jitter,
            self.grid.origin,
            self.voxel_size,
            step=self.voxel_size,
            inv_s=inv_s,
        )

    def refresh(self) -> bool:
        self._brick_min = brick_minimum(self.sdf.detach())
        return False

    def smooth_rows_(self, values: Tensor, rows: Tensor, amount: float, order: int) -> None:
        smooth_rows_(values.view(*self.grid.size, -1), rows, amount, order)

    def diffuse_rows_(self, values: Tensor, rows: Tensor, amount: float, passes: int) -> None:
        diffuse_rows_(values, rows, self.grid.size, amount, passes)

    def occupied(self) -> Tensor:
        return self.features.detach().any(-1)

    def within(self, far: float) -> Tensor:
        return self.sdf.detach().abs() < far

    def blocks(self, far: float) -> Tensor:
        sdf = self.sdf.detach()
        return (brick_minimum(sdf) < far) & (brick_minimum(-sdf) < far)

    def isosurface(self) -> tuple[Tensor, Tensor]:
        sdf = self.sdf.detach().numpy()
        if not sdf.min() < 0 < sdf.max():
            raise NoSurface("the field has no surface: its sdf does not change sign")
        vertices, faces, _, _ = marching_cubes(sdf, 0.0, gradient_direction="descent")
        origin = torch.tensor(self.grid.origin)
        world = origin + self.voxel_size * torch.from_numpy(vertices.copy())
        return world.float(), torch.from_numpy(faces.astype("int32"))

    def bounds(self) -> tuple[Tensor, Tensor]:
        return self.grid.bounds()

    def resized(self, grid: GridShape) -> DenseField:
        with torch.no_grad():
            field = DenseField(grid, self.channels, resample(self.sdf, self.grid, grid))
            field.features.copy_(resample(self.features, self.grid, grid))
        return field
