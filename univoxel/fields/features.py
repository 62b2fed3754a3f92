"""Features of a field: at the nodes of its distances, or from a multiresolution hash table."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from operator import le

import torch
from torch import Tensor, nn

from univoxel.core.records import FieldSample, Rays, Samples
from univoxel.core.validation import check_fields
from univoxel.errors import ConfigError
from univoxel.fields.distances import BAND, AbstractDistances, nodes_within
from univoxel.ops import encode_hash
from univoxel.ops.compositing import FieldAlongRays, Lattices
from univoxel.ops.hash_grid import rows_read

PER_LEVEL = 2  # channels; so levels are half as many as channels
COARSEST = 16  # voxels along the longest side of the box at the coarsest level
ROWS = 2**17  # of a level's table: what the nodes around a surface of 150^3 to 250^3 want
FEWEST_ROWS = 2**10
NODES_AT_ONCE = 16384


class AbstractFeatures(nn.Module, ABC):
    """C features everywhere in the box of distances, which each method is given.

    Gradients to the values are sparse: only the rows that samples read are in them.
    """

    values: nn.Parameter

    @property
    @abstractmethod
    def channels(self) -> int:
        """C."""

    @abstractmethod
    def sample(self, distances: AbstractDistances, points: Tensor) -> FieldSample:
        """SDF, its spatial gradient and features at world points [M, 3]."""

    @abstractmethod
    def at(
        self, distances: AbstractDistances, points: Tensor, values: Tensor | None = None
    ) -> Tensor:
        """The features [M, C] only: no gradient to the sdf, not even one of zeros.

        Args:
            values: read in place of its own.
        """

    @abstractmethod
    def composite(
        self, distances: AbstractDistances, rays: Rays, samples: Samples, inv_s: float
    ) -> FieldAlongRays:
        """Composite distances, their gradient and features along samples of rays."""

    @abstractmethod
    def hold_channels_(self, count: int) -> None:
        """Drop the gradient to the first channels, which then stay as they are."""

    @abstractmethod
    def smooth_(self, distances: AbstractDistances, rows: Tensor, amount: float) -> None:
        """Smooth the features of these rows among their neighbours, where rows have any."""

    @abstractmethod
    def follow_(self, distances: AbstractDistances) -> None:
        """Have a row for every node of distances that have grown; values may be a new parameter."""

    @abstractmethod
    def occupied(self, distances: AbstractDistances) -> Tensor:
        """Which nodes of the grid have features: [X, Y, Z] bool."""

    @abstractmethod
    def rows_near(self, distances: AbstractDistances, far: float) -> Tensor:
        """Which rows of the values are read where the sdf is nearer to 0 than far: [R] bool."""

    @abstractmethod
    def resized(self, source: AbstractDistances, target: AbstractDistances) -> AbstractFeatures:
        """The same features for other distances than the present ones, `source`."""


class NodeFeatures(AbstractFeatures):
    """Features at the nodes of the distances: values are as the sdf, and C."""

    def __init__(self, values: Tensor) -> None:
        super().__init__()
        self.values = nn.Parameter(values)

    @property
    def channels(self) -> int:
        return self.values.shape[-1]

    def sample(self, distances: AbstractDistances, points: Tensor) -> FieldSample:
        return distances.sample(points, self.values)

    def at(
        self, distances: AbstractDistances, points: Tensor, values: Tensor | None = None
    ) -> Tensor:
        return distances.interpolate(self.values if values is None else values, points)

    def composite(
        self, distances: AbstractDistances, rays: Rays, samples: Samples, inv_s: float
    ) -> FieldAlongRays:
        return distances.composite(rays, samples, inv_s, self.values)

    def hold_channels_(self, count: int) -> None:
        assert self.values.grad is not None
        self.values.grad._values()[:, :count] = 0

    def smooth_(self, distances: AbstractDistances, rows: Tensor, amount: float) -> None:
        distances.smooth_rows_(self.values.detach(), rows, amount, order=1)

    def follow_(self, distances: AbstractDistances) -> None:
        values = self.values.detach()
        if more := len(distances.sdf) - len(values):
            values = torch.cat([values, values.new_zeros(more, *values.shape[1:])])
            self.values: nn.Parameter = nn.Parameter(values, self.values.requires_grad)

    def occupied(self, distances: AbstractDistances) -> Tensor:
        return distances.on_grid(self.values.detach().any(-1))

    def rows_near(self, distances: AbstractDistances, far: float) -> Tensor:
        return distances.sdf.detach().abs().flatten() < far

    def resized(self, source: AbstractDistances, target: AbstractDistances) -> NodeFeatures:
        return NodeFeatures(target.values_from(source, self.values.detach()))


@dataclass(frozen=True)
class Levels:
    """Where the lattices of a hash table lie; fixed when the field is made."""

    lower: tuple[float, float, float]  # of the box, world
    upper: tuple[float, float, float]
    voxel_sizes: tuple[float, ...]  # from coarse to fine, world units
    rows: int = ROWS  # of each level's table, a power of two

    def __post_init__(self) -> None:
        corners = "lower", "upper"
        check_fields(self, "finite", lambda x: all(map(math.isfinite, x)), *corners)
        sizes = "voxel_sizes"
        check_fields(self, "above 0", lambda x: x and all(0 < v < math.inf for v in x), sizes)
        check_fields(self, "a power of two", lambda x: x >= 1 and x & (x - 1) == 0, "rows")
        if not all(map(le, self.lower, self.upper)):
            both = f"{self.lower} and {self.upper}"
            raise ConfigError(f"Levels: lower must be at most upper, got {both}")

    @classmethod
    def of(cls, box: tuple[Tensor, Tensor], finest: float, count: int, rows: int = ROWS) -> Levels:
        """`count` levels, their voxels a geometric series down to `finest`."""
        lower, upper = (tuple(corner.tolist()) for corner in box)
        coarsest = max(float((box[1] - box[0]).max()) / COARSEST, finest)
        ratio = (finest / coarsest) ** (1 / max(count - 1, 1))
        return cls(lower, upper, tuple(coarsest * ratio**k for k in range(count)), rows)


class HashFeatures(AbstractFeatures):
    """Features from a table: values are [L * rows, PER_LEVEL].

    They cost what the table costs, however fine the grid. The first L channels are the first of
    each level, and so on: a head that reads the first half reads all resolutions.

    Source: Mueller et al. 2022, "Instant Neural Graphics Primitives"; distances stay on a grid, for
    they are marched through, smoothed and cut at zero.
    """

    def __init__(self, levels: Levels) -> None:
        super().__init__()
        self.levels = levels
        self.values: nn.Parameter = nn.Parameter(
            torch.zeros(len(levels.voxel_sizes) * levels.rows, PER_LEVEL)
        )

    @property
    def channels(self) -> int:
        return PER_LEVEL * len(self.levels.voxel_sizes)

    def sample(self, distances: AbstractDistances, points: Tensor) -> FieldSample:
        return replace(distances.sample(points), features=self.at(distances, points))

    def at(
        self, distances: AbstractDistances, points: Tensor, values: Tensor | None = None
    ) -> Tensor:
        table = self.values if values is None else values
        encoded = encode_hash(table, points, *self._lattices, sparse_grad=True)
        return self._by_channel(encoded)

    def _by_channel(self, encoded: Tensor) -> Tensor:
        """Features [N, C] from those of a level together."""
        n = len(encoded)
        by_level = encoded.view(n, len(self.levels.voxel_sizes), PER_LEVEL)
        return by_level.transpose(1, 2).reshape(n, self.channels)

    def composite(
        self, distances: AbstractDistances, rays: Rays, samples: Samples, inv_s: float
    ) -> FieldAlongRays:
        found = distances.composite(rays, samples, inv_s, self.values, self._lattices)
        return found._replace(features=self._by_channel(found.features))

    @property
    def _lattices(self) -> Lattices:
        return self.levels.lower, self.levels.upper, self.levels.voxel_sizes

    def hold_channels_(self, count: int) -> None:
        grad = self.values.grad
        assert grad is not None
        channel = torch.arange(self.channels).view(PER_LEVEL, -1).T  # [L, PER_LEVEL]
        grad._values().mul_((channel >= count)[grad._indices()[0] // self.levels.rows])

    def smooth_(self, distances: AbstractDistances, rows: Tensor, amount: float) -> None:
        """Nothing: rows have no neighbours, and what is smooth the coarse levels say."""

    def follow_(self, distances: AbstractDistances) -> None:
        """Nothing: rows are no node's."""

    def occupied(self, distances: AbstractDistances) -> Tensor:
        return nodes_within(distances, BAND * distances.voxel_size)

    @torch.no_grad()
    def rows_near(self, distances: AbstractDistances, far: float) -> Tensor:
        if math.isinf(far):
            return torch.ones(len(self.values), dtype=torch.bool)
        # The cube of a voxel around each near node: of every cell that it meets one of these points
        # lies inside, for they are as close together as the nodes of the finest level
        steps = math.ceil(distances.voxel_size / min(self.levels.voxel_sizes) - 1e-3) + 1
        around = torch.cartesian_prod(*[torch.linspace(-0.5, 0.5, steps)] * 3)
        origin = torch.tensor(distances.grid.origin)
        read = torch.zeros(len(self.values), dtype=torch.bool)
        for node in nodes_within(distances, far).nonzero().split(NODES_AT_ONCE):
            points = origin + distances.voxel_size * (node[:, None] + around).reshape(-1, 3)
            read[rows_read(self.values, points, *self._lattices)] = True
        return read

    @torch.no_grad()
    def resized(self, source: AbstractDistances, target: AbstractDistances) -> HashFeatures:
        features = HashFeatures(self.levels)
        features.values.copy_(self.values)
        return features
