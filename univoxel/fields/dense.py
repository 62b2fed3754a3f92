"""A dense grid of signed distances: one at every node."""

from __future__ import annotations

import torch
from skimage.measure import marching_cubes
from torch import Tensor

from univoxel.errors import NoSurface
from univoxel.fields.distances import MIN_SHARE, AbstractDistances, no_values
from univoxel.grid import GridShape, resample
from univoxel.ops import (
    brick_minimum,
    composite_field,
    diffuse_rows_,
    march,
    sample_dense,
    smooth_rows_,
)
from univoxel.ops.composite_field import FieldAlongRays, Lattices
from univoxel.records import FieldSample, Rays, Samples


class DenseDistances(AbstractDistances):
    """SDF [X, Y, Z] as a parameter."""

    def __init__(self, grid: GridShape, sdf: Tensor | None = None) -> None:
        """
        Args:
            sdf: [X, Y, Z] world units; 0 everywhere when left out.
        """
        start = torch.zeros(grid.size) if sdf is None else sdf
        super().__init__(grid, start.contiguous())

    def _brick_minimum(self) -> Tensor:
        return brick_minimum(self.sdf.detach())

    def sample(self, points: Tensor, values: Tensor | None = None) -> FieldSample:
        return self._sample(self.sdf, no_values(self.sdf) if values is None else values, points)

    def interpolate(self, values: Tensor, points: Tensor) -> Tensor:
        return self._sample(self.sdf.detach(), values, points).features

    def _sample(self, sdf: Tensor, values: Tensor, points: Tensor) -> FieldSample:
        place = self.grid.origin, self.voxel_size
        return FieldSample(*sample_dense(sdf, values, points, *place, sparse_grad=True))

    def march(self, rays: Rays, jitter: Tensor, inv_s: float) -> Samples:
        return march(
            self.sdf.detach(),
            self.brick_minimum(),
            rays.origin,
            rays.direction,
            jitter,
            self.grid.origin,
            self.voxel_size,
            step=self.voxel_size,
            inv_s=inv_s,
        )

    def composite(
        self,
        rays: Rays,
        samples: Samples,
        inv_s: float,
        values: Tensor,
        levels: Lattices | None = None,
    ) -> FieldAlongRays:
        return composite_field(
            self.sdf,
            values,
            rays.origin,
            rays.direction,
            samples,
            self.grid.origin,
            self.voxel_size,
            inv_s,
            levels=levels,
            min_share=MIN_SHARE,
            sparse_grad=True,
        )

    def smooth_rows_(self, values: Tensor, rows: Tensor, amount: float, order: int) -> None:
        smooth_rows_(values.view(*self.grid.size, -1), rows, amount, order)

    def diffuse_rows_(self, values: Tensor, rows: Tensor, amount: float, passes: int) -> None:
        diffuse_rows_(values, rows, self.grid.size, amount, passes)

    def on_grid(self, values: Tensor) -> Tensor:
        return values

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

    @torch.no_grad()
    def resized(self, grid: GridShape) -> DenseDistances:
        return DenseDistances(grid, resample(self.sdf, self.grid, grid))

    @torch.no_grad()
    def values_from(self, source: AbstractDistances, values: Tensor) -> Tensor:
        return resample(source.on_grid(values), source.grid, self.grid)
