"""Grids of signed distances: the common interface, the dense grid, and compact storage."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage
from skimage.measure import marching_cubes
from torch import Tensor, nn

from univoxel import ops
from univoxel.core.records import Bricks, FieldSample, Rays, Samples
from univoxel.errors import NoSurface
from univoxel.fields.grid import GridShape, resample
from univoxel.ops.compositing import FieldAlongRays, Lattices

BAND = 4.0  # voxels from the surface beyond which density is nothing: 8 s at a sharpness of 0.5

# Voxels outside that a node beyond the border counts as, where the surface is closed there: the cap
# is rounded at its rim, and flat where the inside is deep
CAP = 0.5

# Of a ray's heaviest sample: of lighter ones, nearly half of all, only the distance is read. What
# they would say of colour is what is seen a fraction of a voxel further on.
MIN_SHARE = 0.05


@dataclass(frozen=True)
class SurfaceVersion:
    """Which state an sdf is in, told without reading it.

    Notices other memory, as in another grid or after `sdf.data = ...`, and what torch counts:
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
        minimum = ops.brick_minimum(self.sdf.detach(), self.bricks)
        self._minimum = minimum, SurfaceVersion.of(self.sdf)
        return minimum

    def sample(self, points: Tensor, values: Tensor | None = None) -> FieldSample:
        """SDF, its spatial gradient and values of nodes, as features, at world points [M, 3].

        Args:
            values: as the sdf, and C; without them C is 0.
        """
        if values is None:
            values = self.sdf.detach().new_empty(*self.sdf.shape, 0)
        return self._sample(self.sdf, values, points)

    def interpolate(self, values: Tensor, points: Tensor) -> Tensor:
        """Values of nodes alone at world points [M, 3]: [M, C]; no gradient to the sdf, not even
        one of zeros."""
        return self._sample(self.sdf.detach(), values, points).features

    def _sample(self, sdf: Tensor, values: Tensor, points: Tensor) -> FieldSample:
        place = points, self.grid.origin, self.voxel_size
        if self.bricks is None:
            return FieldSample(*ops.sample_dense(sdf, values, *place, sparse_grad=True))
        return FieldSample(*ops.sample_sparse(sdf, values, self.bricks, *place, sparse_grad=True))

    def march(self, rays: Rays, jitter: Tensor, inv_s: float) -> Samples:
        """The samples along rays that matter under density sharpness 1 / s; no gradients."""
        return ops.march(
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
        return ops.composite_field(
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
        ops.smooth_rows_(values.view(*nodes, -1), rows, amount, order, self.bricks)

    def diffuse_rows_(self, values: Tensor, rows: Tensor, amount: float, passes: int) -> None:
        """`ops.diffuse_rows_` of values [K] of nodes."""
        ops.diffuse_rows_(values, rows, self.grid.size, amount, passes, self.bricks)

    @abstractmethod
    def on_grid(self, values: Tensor) -> Tensor:
        """Values of nodes where these lie in the grid: [X, Y, Z], and C if they have channels."""

    @abstractmethod
    def blocks(self, far: float) -> Tensor:
        """Whether the sdf can be nearer to 0 than far in each block of 4^3 voxels: [A, B, C]."""

    @abstractmethod
    def isosurface(self, closed: bool = False) -> tuple[Tensor, Tensor]:
        """Vertices [P, 3] float32 and faces [F, 3] int32 of the zero level (marching cubes,
        Lewiner et al. 2003), counter-clockwise seen from outside.

        Args:
            closed: whether a cap, less than a voxel beyond the grid, closes the surface where the
                grid's border cuts it. Otherwise it is open there.

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


# A dense grid of signed distances: one at every node.


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
        return (ops.brick_minimum(sdf) < far) & (ops.brick_minimum(-sdf) < far)

    def isosurface(self, closed: bool = False) -> tuple[Tensor, Tensor]:
        sdf = self.sdf.detach().numpy()
        if not sdf.min() < 0 < sdf.max():
            raise NoSurface("the field has no surface: its sdf does not change sign")
        ends = (sdf.take(end, axis) for axis in range(3) for end in (0, -1))
        rim = int(closed and any((end < 0).any() for end in ends))
        padded = np.pad(sdf, rim, constant_values=CAP * self.voxel_size)
        vertices, faces, _, _ = marching_cubes(padded, 0.0, gradient_direction="descent")
        origin = torch.tensor(self.grid.origin)
        world = origin + self.voxel_size * torch.from_numpy(vertices - np.float32(rim))
        return world.float(), torch.from_numpy(faces.astype("int32"))

    @torch.no_grad()
    def resized(self, grid: GridShape) -> DenseDistances:
        return DenseDistances(grid, resample(self.sdf, self.grid, grid))

    @torch.no_grad()
    def values_from(self, source: AbstractDistances, values: Tensor) -> Tensor:
        return resample(source.on_grid(values), source.grid, self.grid)


# Signed distances as a finished scene stores them: numbers near the surface, sides beyond.


PACKED = ("rows", "values", "side")


def pack(sdf: Tensor, reach: float) -> dict[str, Tensor]:
    """What is left of distances [X, Y, Z] when beyond `reach` of the surface only the side counts.

    Args:
        reach: world units, > 0. Nodes next to one on the other side of the surface are near too.

    Returns:
        rows: [R] int32, flat numbers of the near nodes.
        values: [R] their distances.
        side: [K] int8, -1 inside and 1 outside, of every connected piece of the others, in the
            order of their first nodes.
    """
    inside = sdf.numpy() < 0
    near = sdf.abs().numpy() < reach
    for axis in range(3):
        change = np.diff(inside, axis=axis)
        low = [slice(None)] * 3
        high = list(low)
        low[axis], high[axis] = slice(0, -1), slice(1, None)
        near[tuple(low)] |= change
        near[tuple(high)] |= change
    _, first = _pieces(near)
    rows = torch.from_numpy(np.flatnonzero(near))
    side = torch.from_numpy(np.where(inside.reshape(-1)[first], -1, 1).astype(np.int8))
    return {"rows": rows.int(), "values": sdf.reshape(-1)[rows], "side": side}


def unpack(packed: dict[str, Tensor], size: tuple[int, int, int], far: float) -> Tensor:
    """Distances [X, Y, Z] from what `pack` gave: `far` or minus that where no number is kept. An
    IndexError or ValueError if they belong to a grid of another size."""
    near = np.zeros(size, bool)
    rows = packed["rows"].long()
    near.reshape(-1)[rows.numpy()] = True
    piece, first = _pieces(near)
    side = packed["side"].float()
    if len(side) != len(first):
        raise ValueError(f"expected signs for {len(first)} pieces of the grid, got {len(side)}")
    side = torch.cat([torch.zeros(1), side])
    sdf = far * side[torch.from_numpy(piece).long()]
    sdf.view(-1)[rows] = packed["values"].float()
    return sdf


def _pieces(near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Number of the connected piece of every node that is not near, from 1 in the order of their
    first nodes, 0 for near ones; and the flat number of each piece's first node."""
    piece = np.empty(near.shape, np.int32)
    ndimage.label(~near, output=piece)
    numbers, first = np.unique(piece, return_index=True)
    first = first[numbers > 0]
    order = np.argsort(first)
    renumber = np.zeros(int(piece.max()) + 1, np.int32)
    renumber[numbers[numbers > 0][order]] = np.arange(1, len(order) + 1)
    return renumber[piece], first[order]
