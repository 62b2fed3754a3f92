"""What every grid of signed distances offers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from univoxel.grid import GridShape
from univoxel.ops import (
    brick_minimum,
    composite_field,
    diffuse_rows_,
    march,
    sample_dense,
    sample_sparse,
    smooth_rows_,
)
from univoxel.ops.composite_field import FieldAlongRays, Lattices
from univoxel.records import Bricks, FieldSample, Rays, Samples

BAND = 4.0  # voxels from the surface beyond which density is nothing: 8 s at a sharpness of 0.5

# Of a ray's heaviest sample: of lighter ones, nearly half of all, only the distance is read. What
# they would say of colour is what is seen a fraction of a voxel further on.
MIN_SHARE = 0.05


@dataclass(frozen=True)
class SurfaceVersion:
    """Which state an sdf is in, told without reading it.

    Notices other memory, as of another grid or after `sdf.data = ...`, and what torch counts:
    every change in place of the parameter or of `sdf.detach()`. Changes in place of `sdf.data` are
    the only ones that nobody counts.
    """

    values: Tensor  # the sdf's memory, kept: an address that is free may be used again
    changes: int

    @staticmethod
    def of(sdf: Tensor) -> SurfaceVersion:
        """The present one."""
        return SurfaceVersion(sdf.detach(), sdf._version)

    def holds(self, sdf: Tensor) -> bool:
        """Whether the sdf has not changed since."""
        same_memory = (sdf.data_ptr(), sdf.shape) == (self.values.data_ptr(), self.values.shape)
        return same_memory and sdf._version == self.changes


class AbstractDistances(nn.Module, ABC):
    """Signed distances at nodes of a grid, each with a row of the sdf.

    Gradients to the sdf are sparse: only the nodes around samples are in them, and `RowAdam`
    updates only those. Their rows are the numbers of these nodes. Other values of nodes are tensors
    of the sdf's shape, or with channels after it.
    """

    grid: GridShape
    voxel_size: float  # of the grid, world units
    sdf: nn.Parameter
    bricks: Bricks | None  # that rows of the sdf belong to; None: the sdf is [X, Y, Z]
    pinned: Tensor | None  # as the sdf, bool: nodes that get no gradient; None: none

    def __init__(self, grid: GridShape, sdf: Tensor, bricks: Bricks | None = None) -> None:
        super().__init__()
        self.grid, self.voxel_size = grid, grid.voxel_size
        self.sdf = nn.Parameter(sdf)
        self.bricks = bricks
        self.pinned = None
        self._minimum: tuple[Tensor, SurfaceVersion] | None = None

    def brick_minimum(self) -> Tensor:
        """Of the present sdf, see `ops.brick_minimum`. While the module is in training, where the
        sdf moves in every step: of the sdf at the last `refresh`."""
        if self._minimum is not None:
            minimum, version = self._minimum
            if self.training or version.holds(self.sdf):
                return minimum
        minimum = brick_minimum(self.sdf.detach(), self.bricks)
        self._minimum = minimum, SurfaceVersion.of(self.sdf)
        return minimum

    def sample(self, points: Tensor, values: Tensor | None = None) -> FieldSample:
        """SDF, its spatial gradient and values of nodes, as features, at world points [M, 3].

        Args:
            values: as the sdf, and C; without them C is 0.
        """
        return self._sample(self.sdf, no_values(self.sdf) if values is None else values, points)

    def interpolate(self, values: Tensor, points: Tensor) -> Tensor:
        """Values of nodes alone at world points [M, 3]: [M, C]; no gradient to the sdf, not even
        one of zeros."""
        return self._sample(self.sdf.detach(), values, points).features

    def _sample(self, sdf: Tensor, values: Tensor, points: Tensor) -> FieldSample:
        place = points, self.grid.origin, self.voxel_size
        if self.bricks is None:
            return FieldSample(*sample_dense(sdf, values, *place, sparse_grad=True))
        return FieldSample(*sample_sparse(sdf, values, self.bricks, *place, sparse_grad=True))

    def march(self, rays: Rays, jitter: Tensor, inv_s: float) -> Samples:
        """The samples along rays that matter under density sharpness 1 / s; no gradients."""
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
            bricks=self.bricks,
        )

    def composite(
        self,
        rays: Rays,
        samples: Samples,
        inv_s: float,
        values: Tensor,
        levels: Lattices | None = None,
    ) -> FieldAlongRays:
        """Composite distances and values along samples of rays.

        Args:
            values: of nodes, as features; or a hash table with these levels.
        """
        return composite_field(
            self.sdf,
            values,
            rays.origin,
            rays.direction,
            samples,
            self.grid.origin,
            self.voxel_size,
            inv_s,
            bricks=self.bricks,
            levels=levels,
            min_share=MIN_SHARE,
            sparse_grad=True,
        )

    @torch.no_grad()
    def refresh(self) -> bool:
        """Add nodes where the surface came near, and look again which bricks are empty; True: nodes
        were added.

        Where that needs room, the sdf is a new parameter afterwards, with more rows at the end:
        `RowAdam.follow` takes the optimiser along.
        """
        grown = self._grow()
        self._minimum = None
        return grown

    def _grow(self) -> bool:
        """Add nodes where the surface came near; False: there are none to add."""
        return False

    def smooth_rows_(self, values: Tensor, rows: Tensor, amount: float, order: int) -> None:
        """`ops.smooth_rows_` of values of nodes."""
        nodes = self.grid.size if self.bricks is None else (len(values),)
        smooth_rows_(values.view(*nodes, -1), rows, amount, order, self.bricks)

    def diffuse_rows_(self, values: Tensor, rows: Tensor, amount: float, passes: int) -> None:
        """`ops.diffuse_rows_` of values [K] of nodes."""
        diffuse_rows_(values, rows, self.grid.size, amount, passes, self.bricks)

    @abstractmethod
    def on_grid(self, values: Tensor) -> Tensor:
        """Values of nodes where these lie in the grid: [X, Y, Z], and C if they have channels."""

    @abstractmethod
    def blocks(self, far: float) -> Tensor:
        """Whether the sdf can be nearer to 0 than far in each block of 4^3 voxels: [A, B, C]."""

    @abstractmethod
    def isosurface(self) -> tuple[Tensor, Tensor]:
        """Vertices [P, 3] float32 and faces [F, 3] int32 of the zero level (marching cubes,
        Lewiner et al. 2003), counter-clockwise seen from outside.

        Raises:
            ValueError: the sdf has no zero level.
        """

    @abstractmethod
    def resized(self, grid: GridShape) -> AbstractDistances:
        """The same distances on another grid, by trilinear interpolation."""

    @abstractmethod
    def values_from(self, source: AbstractDistances, values: Tensor) -> Tensor:
        """Values of the source's nodes, with C channels, at the nodes of this grid."""


def nodes_within(distances: AbstractDistances, far: float) -> Tensor:
    """Which nodes of the grid have an sdf nearer to 0 than far: [X, Y, Z] bool."""
    return distances.on_grid(distances.sdf.detach().abs() < far)


def no_values(sdf: Tensor) -> Tensor:
    """Values of nodes with no channels."""
    return sdf.detach().new_empty(*sdf.shape, 0)
