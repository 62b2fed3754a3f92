"""A dense grid of signed distances: one at every node."""

from __future__ import annotations

import torch
from skimage.measure import marching_cubes
from torch import Tensor

from univoxel.errors import NoSurface
from univoxel.fields.distances import AbstractDistances
from univoxel.grid import GridShape, resample
from univoxel.ops import brick_minimum


class DenseDistances(AbstractDistances):
    """SDF [X, Y, Z] as a parameter."""

    def __init__(self, grid: GridShape, sdf: Tensor | None = None) -> None:
        """
        Args:
            sdf: [X, Y, Z] world units; 0 everywhere when left out.
        """
        start = torch.zeros(grid.size) if sdf is None else sdf
        super().__init__(grid, start.contiguous())

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
