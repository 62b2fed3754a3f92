"""A dense grid of distances, and features from a multiresolution hash table."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from univoxel.fields.base import BAND
from univoxel.fields.dense import DenseField
from univoxel.fields.hull import GridShape, resample
from univoxel.ops import encode_hash, sample_dense
from univoxel.records import FieldSample

PER_LEVEL = 2  # channels; so levels are half as many as channels
COARSEST = 16  # voxels along the longest side of the box at the coarsest level
ROWS = 2**17  # of a level's table: what the nodes around a surface of 150^3 to 250^3 want
FEWEST_ROWS = 2**10


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


class HashField(DenseField):
    """SDF [X, Y, Z] and a table [L * rows, PER_LEVEL] of features as parameters.

    Features cost what the table costs, however fine the grid. The first L channels are the first of
    each level, and so on: a head that reads the first half reads all resolutions.

    Source: Mueller et al. 2022, "Instant Neural Graphics Primitives"; distances stay on a grid, for
    they are marched through, smoothed and cut at zero.
    """

    kind = "hash"
    sized = ("features", "channels", "levels")

    def __init__(self, grid: GridShape, channels: int, levels: Levels, sdf: Tensor | None = None):
        if channels != PER_LEVEL * len(levels.voxel_sizes):
            raise ValueError(
                f"HashField: {len(levels.voxel_sizes)} levels have "
                f"{PER_LEVEL * len(levels.voxel_sizes)} channels, got {channels}"
            )
        super().__init__(grid, 0, sdf)
        self.channels, self.levels = channels, levels
        self._no_features = self.features.detach()
        self.features = nn.Parameter(torch.zeros(len(levels.voxel_sizes) * levels.rows, PER_LEVEL))

    def features_at(self, points: Tensor) -> Tensor:
        levels = self.levels
        place = levels.lower, levels.upper, levels.voxel_sizes
        found = encode_hash(self.features, points, *place, sparse_grad=True)
        found = found.view(len(points), len(levels.voxel_sizes), PER_LEVEL)
        return found.transpose(1, 2).reshape(len(points), self.channels)

    def sample(self, points: Tensor) -> FieldSample:
        place = self.grid.origin, self.voxel_size
        sdf, gradient, _ = sample_dense(
            self.sdf, self._no_features, points, *place, sparse_grad=True
        )
        return FieldSample(sdf, gradient, self.features_at(points))

    @property
    def tables(self) -> Tensor:
        """The tables of the levels [L, rows, PER_LEVEL]."""
        return self.features.view(-1, self.levels.rows, PER_LEVEL)

    def channels_of(self, levels: Tensor) -> Tensor:
        """Numbers of the channels, increasing, that levels [K], increasing, are seen in."""
        first = torch.arange(PER_LEVEL) * len(self.levels.voxel_sizes)
        return (first[:, None] + levels).flatten()

    def keep_channels(self, keep: Tensor) -> None:
        """Have only the channels of these numbers, which must be those of some levels.

        Raises:
            ValueError: they are not.
        """
        sizes = self.levels.voxel_sizes
        levels = (keep % len(sizes)).unique()
        if not torch.equal(keep, self.channels_of(levels)):
            raise ValueError(
                f"HashField: channels {keep.tolist()} are not those of whole levels of {len(sizes)}"
            )
        self.features = nn.Parameter(self.tables.data[levels].flatten(0, 1))
        kept = tuple(sizes[k] for k in levels.tolist())
        self.channels, self.levels = len(keep), replace(self.levels, voxel_sizes=kept)

    def hold_channels_(self, count: int) -> None:
        grad = self.features.grad
        assert grad is not None
        channel = torch.arange(self.channels).view(PER_LEVEL, -1).T  # [L, PER_LEVEL]
        grad._values().mul_((channel >= count)[grad._indices()[0] // self.levels.rows])

    def smooth_features_(self, rows: Tensor, amount: float) -> None:
        """Nothing: rows have no neighbours, and what is smooth the coarse levels say."""

    def occupied(self) -> Tensor:
        return self.sdf.detach().abs() < BAND * self.voxel_size

    def resized(self, grid: GridShape) -> HashField:
        with torch.no_grad():
            sdf = resample(self.sdf, self.grid, grid)
            field = HashField(grid, self.channels, self.levels, sdf)
            field.features.copy_(self.features)
        return field
