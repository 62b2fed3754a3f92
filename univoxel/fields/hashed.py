"""Distances of a dense or sparse grid, and features from a multiresolution hash table."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from univoxel.fields.base import BAND, AbstractField
from univoxel.fields.dense import DenseField
from univoxel.fields.sparse import SparseField
from univoxel.grid import GridShape, resample
from univoxel.ops import encode_hash
from univoxel.records import FieldSample, Rays, Samples

PER_LEVEL = 2  # channels; so levels are half as many as channels
COARSEST = 16  # voxels along the longest side of the box at the coarsest level
ROWS = 2**17  # of a level's table: what the nodes around a surface of 150^3 to 250^3 want
FEWEST_ROWS = 2**10
NODES_AT_ONCE = 16384
DENSE_MOST = 8_000_000  # nodes; of finer grids bricks around the surface cost less


@dataclass(frozen=True)
class Levels:
    """Where the lattices of a hash table lie; fixed when the field is made."""

    lower: tuple[float, float, float]  # of the box, world
    upper: tuple[float, float, float]
    voxel_sizes: tuple[float, ...]  # from coarse to fine, world units
    rows: int = ROWS  # of each level's table

    @classmethod
    def of(cls, box: tuple[Tensor, Tensor], finest: float, count: int, rows: int = ROWS) -> Levels:
        """`count` levels, their voxels a geometric series down to `finest`."""
        lower, upper = (tuple(corner.tolist()) for corner in box)
        coarsest = max(float((box[1] - box[0]).max()) / COARSEST, finest)
        ratio = (finest / coarsest) ** (1 / max(count - 1, 1))
        return cls(lower, upper, tuple(coarsest * ratio**k for k in range(count)), rows)


class HashField(AbstractField):
    """Features from a table [L * rows, PER_LEVEL], over the distances of another field.

    Features cost what the table costs, however fine the grid; distances lie on a dense grid, or, on
    one of more than DENSE_MOST nodes, in bricks around the surface. The first L channels are the
    first of each level, and so on: a head that reads the first half reads all resolutions.

    Source: Mueller et al. 2022, "Instant Neural Graphics Primitives"; distances stay on a grid, for
    they are marched through, smoothed and cut at zero.
    """

    kind = "hash"
    by_node = False

    def __init__(self, distances: DenseField | SparseField, levels: Levels):
        """
        Args:
            distances: a field without features, which becomes part of this one.
        """
        super().__init__()
        distances.features.requires_grad_(False)
        self._held = (distances,)  # in a tuple: its sdf is a parameter of this module
        self.sdf = distances.sdf
        self.grid, self.voxel_size = distances.grid, distances.voxel_size
        self.channels, self.levels = PER_LEVEL * len(levels.voxel_sizes), levels
        self.features = nn.Parameter(torch.zeros(len(levels.voxel_sizes) * levels.rows, PER_LEVEL))

    @property
    def distances(self) -> DenseField | SparseField:
        return self._held[0]

    def sample(self, points: Tensor) -> FieldSample:
        return replace(self.distances.sample(points), features=self.features_at(points))

    def features_at(self, points: Tensor) -> Tensor:
        found = self.encode(points).view(len(points), len(self.levels.voxel_sizes), PER_LEVEL)
        return found.transpose(1, 2).reshape(len(points), self.channels)

    def encode(self, points: Tensor) -> Tensor:
        """The features [M, C], those of a level together."""
        levels = self.levels
        place = levels.lower, levels.upper, levels.voxel_sizes
        return encode_hash(self.features, points, *place, sparse_grad=True)

    def march(self, rays: Rays, jitter: Tensor, inv_s: float) -> Samples:
        return self.distances.march(rays, jitter, inv_s)

    def refresh(self) -> bool:
        grown = self.distances.refresh()
        self.sdf = self.distances.sdf
        return grown

    def smooth_rows_(self, values: Tensor, rows: Tensor, amount: float, order: int) -> None:
        self.distances.smooth_rows_(values, rows, amount, order)

    def diffuse_rows_(self, values: Tensor, rows: Tensor, amount: float, passes: int) -> None:
        self.distances.diffuse_rows_(values, rows, amount, passes)

    def hold_channels_(self, count: int) -> None:
        grad = self.features.grad
        assert grad is not None
        channel = torch.arange(self.channels).view(PER_LEVEL, -1).T  # [L, PER_LEVEL]
        grad._values().mul_((channel >= count)[grad._indices()[0] // self.levels.rows])

    def smooth_features_(self, rows: Tensor, amount: float) -> None:
        """Nothing: rows have no neighbours, and what is smooth the coarse levels say."""

    def occupied(self) -> Tensor:
        return self.within(BAND * self.voxel_size)

    def within(self, far: float) -> Tensor:
        return self.distances.within(far)

    @torch.no_grad()
    def rows_near(self, far: float) -> Tensor:
        if math.isinf(far):
            return torch.ones(len(self.features), dtype=torch.bool)
        # The cube of a voxel around each near node: of every cell that it meets one of these points
        # lies inside, for they are as close together as the nodes of the finest level
        steps = math.ceil(self.voxel_size / min(self.levels.voxel_sizes) - 1e-3) + 1
        around = torch.cartesian_prod(*[torch.linspace(-0.5, 0.5, steps)] * 3)
        origin = torch.tensor(self.grid.origin)
        read = torch.zeros(len(self.features), dtype=torch.bool)
        for node in self.within(far).nonzero().split(NODES_AT_ONCE):
            points = origin + self.voxel_size * (node[:, None] + around).reshape(-1, 3)
            with torch.enable_grad():
                encoded = self.encode(points)
            (grad,) = torch.autograd.grad(encoded, self.features, torch.ones_like(encoded))
            read[grad._indices()[0]] = True
        return read

    def blocks(self, far: float) -> Tensor:
        return self.distances.blocks(far)

    def isosurface(self) -> tuple[Tensor, Tensor]:
        return self.distances.isosurface()

    def bounds(self) -> tuple[Tensor, Tensor]:
        return self.grid.bounds()

    @torch.no_grad()
    def resized(self, grid: GridShape) -> HashField:
        source = self.distances
        if isinstance(source, SparseField) or grid.nodes_count > DENSE_MOST:
            distances = SparseField.around(source, grid)
        else:
            distances = DenseField(grid, 0, resample(source.sdf, source.grid, grid))
        field = HashField(distances, self.levels)
        field.features.copy_(self.features)
        return field
