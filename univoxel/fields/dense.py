"""A dense grid: one signed distance and C features at every node."""

from __future__ import annotations

import torch
from skimage.measure import marching_cubes
from torch import Tensor, nn

from univoxel.fields.base import AbstractField
from univoxel.fields.hull import GridShape, resample
from univoxel.ops import brick_minimum, march, sample_dense
from univoxel.records import FieldSample, Rays, Samples


class DenseField(AbstractField):
    """SDF [X, Y, Z] and features [X, Y, Z, C] as parameters.

    Gradients to the grids are sparse: only the nodes around samples are in them, and `RowAdam`
    updates only those.
    """

    def __init__(self, grid: GridShape, channels: int, sdf: Tensor | None = None):
        super().__init__()
        self.grid, self.channels, self.voxel_size = grid, channels, grid.voxel_size
        start = torch.zeros(grid.size) if sdf is None else sdf
        self.sdf = nn.Parameter(start.contiguous())
        self.features = nn.Parameter(torch.zeros(*grid.size, channels))
        self._brick_min: Tensor | None = None

    def sample(self, points: Tensor) -> FieldSample:
        return FieldSample(
            *sample_dense(
                self.sdf,
                self.features,
                points,
                self.grid.origin,
                self.voxel_size,
                sparse_grad=True,
            )
        )

    def march(self, rays: Rays, jitter: Tensor, inv_s: float) -> Samples:
        brick_min = self.refresh() if self._brick_min is None else self._brick_min
        return march(
            self.sdf.detach(),
            brick_min,
            rays.origin,
            rays.direction,
            jitter,
            self.grid.origin,
            self.voxel_size,
            step=self.voxel_size,
            inv_s=inv_s,
        )

    def refresh(self) -> Tensor:
        """Look again which bricks are empty, after the sdf has moved: the least sdf of each."""
        self._brick_min = brick_minimum(self.sdf.detach())
        return self._brick_min

    def isosurface(self) -> tuple[Tensor, Tensor]:
        """Vertices [P, 3] float32 and faces [F, 3] int32 of the zero level (marching cubes,
        Lewiner et al. 2003), counter-clockwise seen from outside.

        Raises:
            ValueError: the sdf has no zero level.
        """
        sdf = self.sdf.detach().numpy()
        if not sdf.min() < 0 < sdf.max():
            raise ValueError("the field has no surface: its sdf does not change sign")
        vertices, faces, _, _ = marching_cubes(sdf, 0.0, gradient_direction="descent")
        origin = torch.tensor(self.grid.origin)
        world = origin + self.voxel_size * torch.from_numpy(vertices.copy())
        return world.float(), torch.from_numpy(faces.astype("int32"))

    def bounds(self) -> tuple[Tensor, Tensor]:
        lower = torch.tensor(self.grid.origin)
        return lower, lower + self.voxel_size * (torch.tensor(self.grid.size) - 1)

    def resized(self, grid: GridShape) -> DenseField:
        """The same field on another grid, by trilinear interpolation."""
        with torch.no_grad():
            field = DenseField(grid, self.channels, resample(self.sdf, self.grid, grid))
            field.features.copy_(resample(self.features, self.grid, grid))
        return field
