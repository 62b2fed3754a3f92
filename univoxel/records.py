"""What one stage of the pipeline hands to the next: frozen records of tensors.

Sizes: N rays, M samples, C features, V views, P points.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


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


@dataclass(frozen=True)
class Occlusion:
    """What stands between N points and distant light, along D directions around each normal.

    The directions are `lights.quadrature.half_sphere(surface, D, rotation)`.
    """

    rotation: Tensor  # [N] radians that the directions are turned by about the normal
    visibility: Tensor  # [N, D] share of the distant light that arrives, in [0, 1]
    indirect: Tensor  # [N, D, 3] linear radiance that arrives from what is in the way, >= 0
