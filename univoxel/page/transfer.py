"""How much of a distant light reaches each vertex past the object itself, and by way of it.

The page's renderer casts no shadows. With these numbers beside each vertex the diffuse part has
soft shadows and colour that neighbours lend each other, under any map, however it is turned: the
irradiance is a dot product with the map's harmonics.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from univoxel.assets.base import TexturedMesh
from univoxel.ops import VisibilityScene
from univoxel.sphere import fibonacci_hemisphere, real_harmonics, to_world

DEGREE = 4  # of harmonics: shadows as soft as some 40 degrees; 25 numbers a vertex
BOUNCE_DEGREE = 1  # of light by way of the object, which is softer still; 4 numbers a colour
RAYS = 256  # of a vertex, over its half-sphere
BOUNCES = 2  # reflections that are followed, as `univoxel relight` does
VERTICES_AT_ONCE = 1024  # bounds memory


@dataclass(frozen=True)
class Transfer:
    """Irradiance over pi of a vertex is the sum over harmonics of these times the map's numbers."""

    direct: Tensor  # [P, 25] float32
    bounced: Tensor  # [P, 3, 4] float32, by colour


@dataclass(frozen=True)
class _Sightings:
    """Rays of vertices that meet the object, M of them."""

    vertex: Tensor  # [M] int64, whose ray
    corner: Tensor  # [M, 3] int64, of the triangle that it meets
    weight: Tensor  # [M, 3], of those corners


def transfer(mesh: TexturedMesh, offset: float) -> Transfer:
    """Traced from each vertex of a mesh, with its albedo.

    Args:
        offset: from the surface, where rays start; world units.

    Source: Sloan, Kautz and Snyder 2002, "Precomputed radiance transfer for real-time rendering
    in dynamic, low-frequency lighting environments", of diffuse surfaces.
    """
    # A seam of the texture doubles vertices: each place once
    places, of_vertex = torch.unique(mesh.vertices, dim=0, return_inverse=True)
    normals = torch.zeros_like(places).index_copy_(0, of_vertex, mesh.normals)
    albedo = torch.zeros_like(places).index_copy_(0, of_vertex, vertex_albedo(mesh))
    faces = of_vertex[mesh.faces.long()]
    direct, seen = _traced(places, normals, faces, offset)
    few = (BOUNCE_DEGREE + 1) ** 2
    lit = direct[:, None, :few].expand(-1, 3, -1)
    bounced = torch.zeros_like(lit)
    for _ in range(BOUNCES):
        sent = albedo[:, :, None] * (lit + bounced)
        met = torch.einsum("mk,mkcl->mcl", seen.weight, sent[seen.corner])
        bounced = torch.zeros_like(lit).index_add_(0, seen.vertex, met / RAYS)
    return Transfer(direct[of_vertex], bounced[of_vertex])


def vertex_albedo(mesh: TexturedMesh) -> Tensor:
    """The texture's albedo at the vertices, [P, 3]."""
    size = len(mesh.albedo)
    column, row = (size * mesh.uv[:, 0]).long(), (size * (1 - mesh.uv[:, 1])).long()
    return mesh.albedo[row.clamp(0, size - 1), column.clamp(0, size - 1)]


def _traced(
    places: Tensor, normals: Tensor, faces: Tensor, offset: float
) -> tuple[Tensor, _Sightings]:
    """Harmonics [P, 25] of the open sky weighted by the cosine over pi, and what hides the rest."""
    visibility = VisibilityScene(places, faces)
    local = fibonacci_hemisphere(RAYS)
    # Evenly over the disc below them: the cosine is in their density
    radius = (1 - local[:, 2]).sqrt() / (1 - local[:, 2] ** 2).clamp_min(1e-12).sqrt()
    local = torch.cat([local[:, :2] * radius[:, None], local[:, 2:].sqrt()], 1)
    direct, parts = [], []
    for start in range(0, len(places), VERTICES_AT_ONCE):
        some = slice(start, start + VERTICES_AT_ONCE)
        direction = to_world(local, normals[some, None])
        origin = (places[some] + offset * normals[some])[:, None].expand_as(direction)
        hit = visibility.closest_hit(origin.reshape(-1, 3), direction.reshape(-1, 3))
        open_sky = (hit.face < 0).reshape(len(direction), RAYS)
        harmonics = real_harmonics(DEGREE, direction)
        direct.append(torch.einsum("pr,prk->pk", open_sky.float(), harmonics) / RAYS)
        met = (hit.face >= 0).nonzero()[:, 0]
        u, v = hit.barycentric[met].unbind(1)
        weight = torch.stack([1 - u - v, u, v], 1)
        parts.append((start + met // RAYS, faces[hit.face[met]], weight))
    return torch.cat(direct), _Sightings(*(torch.cat(part) for part in zip(*parts, strict=True)))
