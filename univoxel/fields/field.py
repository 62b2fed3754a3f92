"""A field: signed distances and features inside a box, and the small networks that decode them."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from univoxel.core.choices import FieldName
from univoxel.core.records import FieldSample, Rays, Samples
from univoxel.fields.bricks import BrickDistances
from univoxel.fields.distances import AbstractDistances, DenseDistances
from univoxel.fields.features import AbstractFeatures, HashFeatures, Levels, NodeFeatures
from univoxel.fields.grid import GridShape
from univoxel.ops.compositing import FieldAlongRays
from univoxel.ops.networks import MLP, DirectionTable, waves


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


DENSE_MOST = 8_000_000  # nodes; of finer grids bricks around the surface cost less
# Names of the parameters in `state_dict`, and so in files
NAMES = {"distances.sdf": "sdf", "encoding.values": "features"}


class Field(nn.Module):
    """Distances on a grid, and features over them.

    In `state_dict` the parameters are `sdf` and `features`, as files have them.
    """

    def __init__(self, distances: AbstractDistances, encoding: AbstractFeatures) -> None:
        """
        Args:
            encoding: made for these distances.
        """
        super().__init__()
        self.distances: AbstractDistances = distances
        self.encoding: AbstractFeatures = encoding
        self._register_state_dict_hook(_outward)
        self._register_load_state_dict_pre_hook(_inward)

    def __setattr__(self, name: str, value: Any) -> None:
        """Let sdf and features be replaced: a module would keep parameters of its own by these
        names."""
        if name == "sdf":
            self.distances.sdf = value
        elif name == "features":
            self.encoding.values = value
        else:
            super().__setattr__(name, value)

    @property
    def kind(self) -> FieldName:
        """Its name in configurations and files."""
        if isinstance(self.encoding, HashFeatures):
            return "hash"
        return "sparse" if isinstance(self.distances, BrickDistances) else "dense"

    @property
    def grid(self) -> GridShape:
        return self.distances.grid

    @property
    def voxel_size(self) -> float:
        """Of the grid, world units."""
        return self.distances.voxel_size

    @property
    def channels(self) -> int:
        """C, of the features."""
        return self.encoding.channels

    @property
    def sdf(self) -> nn.Parameter:
        """[X, Y, Z], or [R] of the rows of bricks."""
        return self.distances.sdf

    @property
    def features(self) -> nn.Parameter:
        """As the sdf, and C; or a table [R, F] of its own."""
        return self.encoding.values

    def sample(self, points: Tensor) -> FieldSample:
        """SDF, its spatial gradient and features at world points [M, 3]."""
        return self.encoding.sample(self.distances, points)

    def features_at(self, points: Tensor, values: Tensor | None = None) -> Tensor:
        """The features [M, C] only: no gradient to the sdf, not even one of zeros.

        Args:
            values: as `features`, read in their place.
        """
        return self.encoding.at(self.distances, points, values)

    def march(self, rays: Rays, jitter: Tensor, inv_s: float) -> Samples:
        """The samples along rays that matter under density sharpness 1 / s; no gradients."""
        return self.distances.march(rays, jitter, inv_s)

    def composite(self, rays: Rays, samples: Samples, inv_s: float) -> FieldAlongRays:
        """Composite distances, their gradient and features along samples of rays, in one pass."""
        return self.encoding.composite(self.distances, rays, samples, inv_s)

    @torch.no_grad()
    def refresh(self) -> bool:
        """Look again which bricks are empty, after the sdf has moved; True: nodes were added.

        Where a field needs room for that, sdf and features are new parameters afterwards, with
        more rows at the end: `RowAdam.follow` takes the optimiser along.
        """
        grown = self.distances.refresh()
        self.encoding.follow_(self.distances)
        return grown

    def occupied(self) -> Tensor:
        """Which nodes of the grid have features: [X, Y, Z] bool."""
        return self.encoding.occupied(self.distances)

    def rows_near(self, far: float) -> Tensor:
        """Which rows of the features are read where the sdf is nearer to 0 than far: [R] bool."""
        return self.encoding.rows_near(self.distances, far)

    def isosurface(self, closed: bool = False) -> tuple[Tensor, Tensor]:
        """Vertices [P, 3] float32 and faces [F, 3] int32 of the zero level, see
        `AbstractDistances.isosurface`."""
        return self.distances.isosurface(closed)

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lower and upper corner [3], [3] of the box, world units."""
        return self.grid.bounds()

    def resized(self, grid: GridShape) -> Field:
        """The same field on another grid, by trilinear interpolation.

        Over a hash table distances lie in bricks from DENSE_MOST nodes on, and stay there.
        """
        if isinstance(self.encoding, HashFeatures) and grid.nodes_count > DENSE_MOST:
            return self.in_bricks(grid)
        return self._over(self.distances.resized(grid))

    def in_bricks(self, grid: GridShape) -> Field:
        """What the field is near its surface, in bricks of another grid."""
        return self._over(BrickDistances.around(self.distances, grid))

    def _over(self, distances: AbstractDistances) -> Field:
        return Field(distances, self.encoding.resized(self.distances, distances))


def dense_field(grid: GridShape, channels: int, sdf: Tensor | None = None) -> Field:
    """Distances and features, 0 at first, at every node of a grid.

    Args:
        sdf: [X, Y, Z] world units; 0 everywhere when left out.
    """
    return Field(DenseDistances(grid, sdf), NodeFeatures(torch.zeros(*grid.size, channels)))


def hash_field(grid: GridShape, levels: Levels, sdf: Tensor | None = None) -> Field:
    """Distances at every node of a grid, and features, 0 at first, from a hash table.

    Args:
        sdf: [X, Y, Z] world units; 0 everywhere when left out.
    """
    return Field(DenseDistances(grid, sdf), HashFeatures(levels))


def _outward(field: Field, tensors: dict, prefix: str, _: dict) -> None:
    for inner, name in NAMES.items():
        tensors[prefix + name] = tensors.pop(prefix + inner)


def _inward(tensors: dict, prefix: str, *_) -> None:
    for inner, name in NAMES.items():
        if prefix + name in tensors:
            tensors[prefix + inner] = tensors.pop(prefix + name)
