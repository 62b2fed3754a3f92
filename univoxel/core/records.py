"""Frozen records of tensors that stages of the pipeline pass on.

Sizes: N rays, M samples, C features, V views, P points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, TypeAlias

import torch
from torch import Tensor

HALF_MAX = 65504.0  # the largest number of half precision
# Linear albedo [N, 3] in place of the field's: of points of the surface [N, 3], their unit normals
# [N, 3], the field's albedo there [N, 3], and the width in world units of what is asked for
AlbedoNear: TypeAlias = Callable[[Tensor, Tensor, Tensor, float], Tensor]


@dataclass(frozen=True)
class Rays:
    """Half-lines in the world."""

    origin: Tensor  # [N, 3]
    direction: Tensor  # [N, 3] unit


@dataclass(frozen=True)
class Samples:
    """Places along rays, packed: ray n owns samples offsets[n] .. offsets[n + 1], front to back."""

    t: Tensor  # [M] distance from the ray's origin, world units
    connected: Tensor  # [M] bool: the next sample of the ray ends the section that starts here
    offsets: Tensor  # [N + 1] int64


@dataclass(frozen=True)
class FieldSample:
    """What a field says of points."""

    sdf: Tensor  # [M] signed distance, world units, negative inside
    gradient: Tensor  # [M, 3] of the sdf, about unit length
    features: Tensor  # [M, C]


@dataclass(frozen=True)
class Bricks:
    """Where the nodes of a sparse grid lie: in n bricks of 4^3, those of one brick together.

    Node (i, j, k) is row 64 table[i // 4, j // 4, k // 4] + 16 (i % 4) + 4 (j % 4) + k % 4 of a
    pool of 64 n rows. Bricks 0 and 1 stand for all that are missing, outside and inside the
    surface: what they hold is what is seen there, and they get no gradient.

    Raises:
        ValueError: table, place and size do not fit each other.
    """

    table: Tensor  # [A, B, C] int32 number of a brick, in [0, n); not to be changed in place
    place: Tensor  # [n] int32 where in the flat table a brick stands; -1: nowhere, as 0 and 1
    size: tuple[int, int, int]  # nodes of the whole grid

    SIDE: ClassVar[int] = 4
    NODES: ClassVar[int] = 64  # in a brick
    MISSING: ClassVar[int] = 2  # bricks that stand for missing ones

    def __post_init__(self) -> None:
        shape = tuple(-(-n // self.SIDE) for n in self.size)
        for name, tensor, wanted in (
            ("table", self.table, shape),
            ("place", self.place, (max(len(self.place), self.MISSING),)),
        ):
            if tuple(tensor.shape) != wanted or tensor.dtype != torch.int32:
                raise ValueError(
                    f"Bricks: {name} must be {list(wanted)} int32 for size {list(self.size)}, got "
                    f"{list(tensor.shape)} {str(tensor.dtype).removeprefix('torch.')}"
                )
        flat, n = self.table.flatten(), len(self.place)
        stored = (flat >= self.MISSING).nonzero()[:, 0]
        number = flat[stored].long()
        fits = not flat.numel() or bool(flat.min() >= 0 and flat.max() < n)
        fits = fits and int((self.place >= 0).sum()) == len(stored)
        if not fits or not bool((self.place[number] == stored).all()):
            raise ValueError(
                f"Bricks: table must hold each of {n} bricks at its place, and 0 or 1 elsewhere"
            )

    def corners(self, brick: Tensor) -> Tensor:
        """First node of bricks [K] that stand somewhere: [K, 3] int64."""
        at = torch.unravel_index(self.place[brick].long(), self.table.shape)
        return torch.stack(at, -1) * self.SIDE

    def rows(self, node: Tensor) -> Tensor:
        """Rows of nodes [..., 3] int64 of the grid: [...] int64."""
        block, inside = node // self.SIDE, node % self.SIDE
        brick = self.table[block.unbind(-1)].long()
        i, j, k = inside.unbind(-1)
        return brick * self.NODES + 16 * i + 4 * j + k

    def grid_rows(self) -> Tensor:
        """Rows of all nodes of the grid: [X, Y, Z] int64."""
        axes = [torch.arange(n, device=self.table.device) for n in self.size]
        return self.rows(torch.stack(torch.meshgrid(*axes, indexing="ij"), -1))


@dataclass(frozen=True)
class Surface:
    """What a ray meets: sample values composited along it, divided by its opacity."""

    position: Tensor  # [N, 3] world
    normal: Tensor  # [N, 3] unit, world
    features: Tensor  # [N, C]
    albedo: Tensor  # [N, 3] linear, in [0, 1]; of a metal: its F0, see univoxel.brdf.split
    roughness: Tensor  # [N] perceptual, in [0, 1]; GGX alpha is its square
    opacity: Tensor  # [N] in [0, 1]; where it is 0 the rest means nothing
    depth: Tensor  # [N] distance along the ray, world units
    metallic: Tensor | None = None  # [N] in [0, 1]; None: no metal anywhere


@dataclass(frozen=True)
class Mesh:
    """Triangles in the world, counter-clockwise seen from outside, with materials at vertices."""

    vertices: Tensor  # [P, 3] float32
    faces: Tensor  # [F, 3] int32
    normals: Tensor | None = None  # [P, 3] float32 unit
    albedo: Tensor | None = None  # [P, 3] float32 linear
    roughness: Tensor | None = None  # [P] float32
    metallic: Tensor | None = None  # [P] float32 in [0, 1]; None: no metal anywhere
    # [P] float32: 1 where a photograph sees the surface, 0 where it is a guess, between the two at
    # the border; None: not known
    seen: Tensor | None = None


@dataclass(frozen=True)
class Occlusion:
    """What stands between N points and distant light, along D directions around each normal.

    The directions are `lights.quadrature.half_sphere(surface, D, rotation)`.
    """

    rotation: Tensor  # [N] radians that the directions are turned by about the normal
    visibility: Tensor  # [N, D] share of the distant light that arrives, in [0, 1]
    indirect: Tensor  # [N, D, 3] linear radiance that arrives from what is in the way, >= 0
