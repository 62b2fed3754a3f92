"""A field: signed distances and features inside a box, and the small networks that decode them."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from operator import le
from typing import Any

import torch
from torch import Tensor, nn

from univoxel.core.choices import FieldName
from univoxel.core.records import FieldSample, Rays, Samples
from univoxel.core.validation import check_fields
from univoxel.errors import ConfigError
from univoxel.fields.bricks import BrickDistances
from univoxel.fields.distances import BAND, AbstractDistances, DenseDistances, nodes_within
from univoxel.fields.grid import GridShape
from univoxel.ops import encode_hash
from univoxel.ops.compositing import FieldAlongRays, Lattices
from univoxel.ops.hash_grid import rows_read
from univoxel.ops.networks import MLP, DirectionTable, waves

PER_LEVEL = 2  # channels; so levels are half as many as channels
COARSEST = 16  # voxels along the longest side of the box at the coarsest level
ROWS = 2**17  # of a level's table: what the nodes around a surface of 150^3 to 250^3 want
FEWEST_ROWS = 2**10
NODES_AT_ONCE = 16384
DENSE_MOST = 8_000_000  # nodes; of finer grids bricks around the surface cost less


class MaterialHead(nn.Module):
    """The first `channels` features of [N, C] -> albedo [N, 3], roughness [N] and metallic [N].

    Albedo is the base colour of glTF: of a metal, what it reflects at normal incidence.
    """

    min_roughness: float = 0.05  # below, a highlight is narrower than the light's own detail

    def __init__(self, channels: int, hidden: int, roughness: float | None = None) -> None:
        """
        Args:
            roughness: of everything, if it is known: then nothing is metal. None: both are learned.
        """
        super().__init__()
        self.channels: int = channels
        self.roughness: float | None = roughness
        self.net: MLP = MLP([channels, hidden, hidden, 5])
        last = self.net.linear[-1]
        # Start mid-grey, glossy and no metal, whatever the features. Glossy: what is rough becomes
        # so, but for what starts rough the light makes itself sharp enough, and too bright.
        with torch.no_grad():
            last.weight.mul_(0.1)
            last.bias.copy_(torch.tensor([0.0, 0.0, 0.0, -1.3, -4.0]))

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        out = torch.sigmoid(self.net(features[:, : self.channels]))
        if self.roughness is not None:
            known = torch.full_like(out[:, 3], self.roughness)
            return out[:, :3], known, torch.zeros_like(known)
        low = self.min_roughness
        return out[:, :3], low + (1 - low) * out[:, 3], out[:, 4]

    @torch.no_grad()
    def shift_albedo(self, features: Tensor, median: Tensor) -> None:
        """Make every channel brighter or darker, to those medians [3] over features [N, C]."""
        medians = torch.stack([median, self(features)[0].median(0).values])
        wanted, now = torch.logit(medians, eps=1e-4)
        self.net.linear[-1].bias[:3] += wanted - now

    @torch.no_grad()
    def shift_roughness(self, features: Tensor, median: float) -> None:
        """Make everything rougher or glossier, to that median over features [N, C]; what is known
        stays."""
        if self.roughness is None:
            medians = torch.stack([torch.tensor(median), self(features)[1].median()])
            low = self.min_roughness
            wanted, now = torch.logit((medians - low) / (1 - low), eps=1e-4)
            self.net.linear[-1].bias[3] += wanted - now


class RadianceHead(nn.Module):
    """Outgoing radiance without any model of light: it lets geometry converge early.

    Reads features, normal, the mirrored view direction (Verbin et al. 2022, Ref-NeRF), what a table
    holds of it, and n.wo; returns sRGB-encoded colour, so that the network is as fine in the dark
    as the eye is.
    """

    def __init__(self, channels: int, hidden: int, levels: int = 0) -> None:
        """
        Args:
            levels: of the table of reflected directions, >= 0.
        """
        super().__init__()
        self.directions: DirectionTable = DirectionTable(levels)
        self.net: MLP = MLP([channels + 3 + 9 + 1 + self.directions.channels, hidden, hidden, 3])

    def forward(self, features: Tensor, normal: Tensor, wo: Tensor) -> Tensor:
        cosine = (normal * wo).sum(1, keepdim=True)
        mirrored = 2 * cosine * normal - wo
        seen = [mirrored, *waves(2 * mirrored, 1), cosine, self.directions(mirrored)]
        return torch.sigmoid(self.net(torch.cat([features, normal, *seen], 1)))


# A field: signed distances and features everywhere in a box.


class Field(nn.Module, ABC):
    """Distances on a grid, and C features over them.

    Gradients to the features are sparse: only the rows that samples read are in them. In
    `state_dict` the parameters are `sdf` and `features`, as files have them.
    """

    features: nn.Parameter  # as the sdf, and C; or a table [R, F] of its own

    def __init__(self, distances: AbstractDistances, features: Tensor) -> None:
        super().__init__()
        self.distances: AbstractDistances = distances
        self.features = nn.Parameter(features)
        self._register_state_dict_hook(_outward)
        self._register_load_state_dict_pre_hook(_inward)

    def __setattr__(self, name: str, value: Any) -> None:
        """Let the sdf be replaced: a module would keep a parameter of its own by this name."""
        owner = self.distances if name == "sdf" else super()
        owner.__setattr__(name, value)

    @property
    @abstractmethod
    def kind(self) -> FieldName:
        """Its name in configurations and files."""

    @property
    @abstractmethod
    def channels(self) -> int:
        """C, of the features."""

    @property
    def grid(self) -> GridShape:
        return self.distances.grid

    @property
    def voxel_size(self) -> float:
        """Of the grid, world units."""
        return self.distances.voxel_size

    @property
    def sdf(self) -> nn.Parameter:
        """[X, Y, Z], or [R] of the rows of bricks."""
        return self.distances.sdf

    @abstractmethod
    def sample(self, points: Tensor) -> FieldSample:
        """SDF, its spatial gradient and features at world points [M, 3]."""

    @abstractmethod
    def features_at(self, points: Tensor, values: Tensor | None = None) -> Tensor:
        """The features [M, C] only: no gradient to the sdf, not even one of zeros.

        Args:
            values: as `features`, read in their place.
        """

    def march(self, rays: Rays, jitter: Tensor, inv_s: float) -> Samples:
        """The samples along rays that matter under density sharpness 1 / s; no gradients."""
        return self.distances.march(rays, jitter, inv_s)

    @abstractmethod
    def composite(self, rays: Rays, samples: Samples, inv_s: float) -> FieldAlongRays:
        """Composite distances, their gradient and features along samples of rays, in one pass."""

    @torch.no_grad()
    def refresh(self) -> bool:
        """Look again which bricks are empty, after the sdf has moved; True: nodes were added.

        Where a field needs room for that, sdf and features are new parameters afterwards, with
        more rows at the end: `RowAdam.follow` takes the optimiser along.
        """
        return self.distances.refresh()

    @abstractmethod
    def hold_channels_(self, count: int) -> None:
        """Drop the gradient to the first channels, which then stay as they are."""

    @abstractmethod
    def smooth_features_(self, rows: Tensor, amount: float) -> None:
        """Smooth the features of these rows among their neighbours, where rows have any."""

    @abstractmethod
    def occupied(self) -> Tensor:
        """Which nodes of the grid have features: [X, Y, Z] bool."""

    @abstractmethod
    def rows_near(self, far: float) -> Tensor:
        """Which rows of the features are read where the sdf is nearer to 0 than far: [R] bool."""

    def isosurface(self, closed: bool = False) -> tuple[Tensor, Tensor]:
        """Vertices [P, 3] float32 and faces [F, 3] int32 of the zero level, see
        `AbstractDistances.isosurface`."""
        return self.distances.isosurface(closed)

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lower and upper corner [3], [3] of the box, world units."""
        return self.grid.bounds()

    def resized(self, grid: GridShape) -> Field:
        """The same field on another grid, by trilinear interpolation."""
        return self._over(self.distances.resized(grid))

    def in_bricks(self, grid: GridShape) -> Field:
        """What the field is near its surface, in bricks of another grid."""
        return self._over(BrickDistances.around(self.distances, grid))

    @abstractmethod
    def _over(self, distances: AbstractDistances) -> Field:
        """The same features for other distances."""


class NodeField(Field):
    """Features at the nodes of the distances: [X, Y, Z, C], or [R, C] of the rows of bricks."""

    @property
    def kind(self) -> FieldName:
        return "sparse" if isinstance(self.distances, BrickDistances) else "dense"

    @property
    def channels(self) -> int:
        return self.features.shape[-1]

    def sample(self, points: Tensor) -> FieldSample:
        return self.distances.sample(points, self.features)

    def features_at(self, points: Tensor, values: Tensor | None = None) -> Tensor:
        return self.distances.interpolate(self.features if values is None else values, points)

    def composite(self, rays: Rays, samples: Samples, inv_s: float) -> FieldAlongRays:
        return self.distances.composite(rays, samples, inv_s, self.features)

    @torch.no_grad()
    def refresh(self) -> bool:
        grown = super().refresh()
        values = self.features.detach()
        if more := len(self.sdf) - len(values):
            values = torch.cat([values, values.new_zeros(more, *values.shape[1:])])
            self.features: nn.Parameter = nn.Parameter(values, self.features.requires_grad)
        return grown

    def hold_channels_(self, count: int) -> None:
        assert self.features.grad is not None
        self.features.grad._values()[:, :count] = 0

    def smooth_features_(self, rows: Tensor, amount: float) -> None:
        self.distances.smooth_rows_(self.features.detach(), rows, amount, order=1)

    def occupied(self) -> Tensor:
        return self.distances.on_grid(self.features.detach().any(-1))

    def rows_near(self, far: float) -> Tensor:
        return self.sdf.detach().abs().flatten() < far

    def _over(self, distances: AbstractDistances) -> NodeField:
        features = distances.values_from(self.distances, self.features.detach())
        return NodeField(distances, features)


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


class HashField(Field):
    """Features from a table: [L * rows, PER_LEVEL].

    They cost what the table costs, however fine the grid. The first L channels are the first of
    each level, and so on: a head that reads the first half reads all resolutions.

    Source: Mueller et al. 2022, "Instant Neural Graphics Primitives"; distances stay on a grid, for
    they are marched through, smoothed and cut at zero.
    """

    def __init__(self, distances: AbstractDistances, levels: Levels) -> None:
        super().__init__(distances, torch.zeros(len(levels.voxel_sizes) * levels.rows, PER_LEVEL))
        self.levels = levels

    @property
    def kind(self) -> FieldName:
        return "hash"

    @property
    def channels(self) -> int:
        return PER_LEVEL * len(self.levels.voxel_sizes)

    def sample(self, points: Tensor) -> FieldSample:
        return replace(self.distances.sample(points), features=self.features_at(points))

    def features_at(self, points: Tensor, values: Tensor | None = None) -> Tensor:
        table = self.features if values is None else values
        return self._by_channel(encode_hash(table, points, *self._lattices, sparse_grad=True))

    def _by_channel(self, encoded: Tensor) -> Tensor:
        """Features [N, C] from those of a level together."""
        n = len(encoded)
        by_level = encoded.view(n, len(self.levels.voxel_sizes), PER_LEVEL)
        return by_level.transpose(1, 2).reshape(n, self.channels)

    def composite(self, rays: Rays, samples: Samples, inv_s: float) -> FieldAlongRays:
        found = self.distances.composite(rays, samples, inv_s, self.features, self._lattices)
        return found._replace(features=self._by_channel(found.features))

    @property
    def _lattices(self) -> Lattices:
        return self.levels.lower, self.levels.upper, self.levels.voxel_sizes

    def hold_channels_(self, count: int) -> None:
        grad = self.features.grad
        assert grad is not None
        channel = torch.arange(self.channels).view(PER_LEVEL, -1).T  # [L, PER_LEVEL]
        grad._values().mul_((channel >= count)[grad._indices()[0] // self.levels.rows])

    def smooth_features_(self, rows: Tensor, amount: float) -> None:
        """Nothing: rows have no neighbours, and what is smooth the coarse levels say."""

    def occupied(self) -> Tensor:
        return nodes_within(self.distances, BAND * self.voxel_size)

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
        for node in nodes_within(self.distances, far).nonzero().split(NODES_AT_ONCE):
            points = origin + self.voxel_size * (node[:, None] + around).reshape(-1, 3)
            read[rows_read(self.features, points, *self._lattices)] = True
        return read

    def resized(self, grid: GridShape) -> Field:
        """As of any field; from DENSE_MOST nodes on distances lie in bricks, and stay there."""
        return self.in_bricks(grid) if grid.nodes_count > DENSE_MOST else super().resized(grid)

    @torch.no_grad()
    def _over(self, distances: AbstractDistances) -> HashField:
        field = HashField(distances, self.levels)
        field.features.copy_(self.features)
        return field


def dense_field(grid: GridShape, channels: int, sdf: Tensor | None = None) -> NodeField:
    """Distances and features, 0 at first, at every node of a grid.

    Args:
        sdf: [X, Y, Z] world units; 0 everywhere when left out.
    """
    return NodeField(DenseDistances(grid, sdf), torch.zeros(*grid.size, channels))


def hash_field(grid: GridShape, levels: Levels, sdf: Tensor | None = None) -> HashField:
    """Distances at every node of a grid, and features, 0 at first, from a hash table.

    Args:
        sdf: [X, Y, Z] world units; 0 everywhere when left out.
    """
    return HashField(DenseDistances(grid, sdf), levels)


def _outward(field: Field, tensors: dict, prefix: str, _: dict) -> None:
    tensors[f"{prefix}sdf"] = tensors.pop(f"{prefix}distances.sdf")


def _inward(tensors: dict, prefix: str, *_) -> None:
    if f"{prefix}sdf" in tensors:
        tensors[f"{prefix}distances.sdf"] = tensors.pop(f"{prefix}sdf")
