"""Reads a scene's field into the vertices or the texture of a mesh that lies near its surface."""

from __future__ import annotations

import torch
from torch import Tensor

from univoxel.assets.atlas import dilated, rasterise, unwrap, vertex_normals, vertex_tangents
from univoxel.assets.base import TexturedMesh
from univoxel.brdf import metal_or_none
from univoxel.errors import UserError
from univoxel.fields.field import Field
from univoxel.records import FieldSample, Mesh
from univoxel.scene import Scene

POINTS_AT_ONCE = 1 << 17  # bounds memory
NEWTON_STEPS = 4
REACH = 2.0  # voxels: how far a point of the mesh may be moved to meet the field's surface
MIN_Z = 0.05  # of a texel's normal in the tangent frame: it looks out of the triangle


def nearest_surface(field: Field, points: Tensor) -> tuple[Tensor, FieldSample]:
    """Points [M, 3] moved onto the field's zero level, and the field there.

    Newton steps along the gradient, x - f grad f / |grad f|^2; where they would lead further than
    two voxels away (the mesh cuts a corner, the field is no distance) they end there.
    """
    x, reach = points, REACH * field.voxel_size
    for _ in range(NEWTON_STEPS):
        at = field.sample(x)
        slope = at.gradient.square().sum(1).clamp_min(1e-6)
        moved = x - (at.sdf / slope)[:, None] * at.gradient - points
        length = moved.norm(dim=1, keepdim=True)
        x = points + moved * (reach / length.clamp_min(reach))
    return x, field.sample(x)


@torch.no_grad()
def with_materials(scene: Scene, mesh: Mesh) -> Mesh:
    """A mesh with the field's normal and materials at its vertices, which stay in place."""
    parts = []
    for points in mesh.vertices.split(POINTS_AT_ONCE):
        _, at = nearest_surface(scene.field, points)
        normal = torch.nn.functional.normalize(at.gradient, dim=1, eps=1e-6)
        parts.append((normal, *scene.material(at.features)))
    *rest, metallic = (torch.cat(p) for p in zip(*parts, strict=True))
    return Mesh(mesh.vertices, mesh.faces, *rest, metallic=metal_or_none(metallic))


@torch.no_grad()
def bake(scene: Scene, mesh: Mesh, size: int) -> TexturedMesh:
    """Textures of size x size texels for a mesh near the scene's surface.

    Each texel's centre is a point of its triangle; the field at the surface beside it gives normal
    and materials. So relief that the triangles are too coarse for lies in the texture.
    Texels outside of the charts copy the nearest inside.

    Raises:
        ValueError: no texel lies in a triangle.
    """
    source, faces, uv = unwrap(mesh, size)
    vertices, normals = mesh.vertices[source], vertex_normals(mesh)[source]
    tangents = vertex_tangents(vertices, faces, normals, uv)
    texel, face, weight = rasterise(uv, faces, size)
    if not len(texel):
        raise UserError(f"a texture of {size} x {size} is too small for {len(faces)} faces")
    parts = []
    for some, w in zip(face.split(POINTS_AT_ONCE), weight.split(POINTS_AT_ONCE), strict=True):
        corner = faces[some].long()
        point, n, t = (
            torch.einsum("mk,mkc->mc", w, values[corner])
            for values in (vertices, normals, tangents)
        )
        _, at = nearest_surface(scene.field, point)
        parts.append((in_frame(at.gradient, n, t), *scene.material(at.features)))
    place = dilated(texel, size)
    *rest, metallic = (torch.cat(p)[place] for p in zip(*parts, strict=True))
    return TexturedMesh(
        vertices, faces, normals, tangents, uv, *rest, metallic=metal_or_none(metallic)
    )


def in_frame(direction: Tensor, normal: Tensor, tangent: Tensor) -> Tensor:
    """Unit coordinates [M, 3] of directions [M, 3] in the frame of `TexturedMesh`.

    The frame is not orthonormal (it is interpolated), so this solves for them. Directions below
    the triangle are bent up to its side.

    Args:
        normal: [M, 3], tangent: [M, 4], interpolated and not normalised.
    """
    t = tangent[:, :3]
    b = tangent[:, 3:] * torch.linalg.cross(normal, t)
    # Cramer's rule, up to the determinant, whose sign is all that normalising leaves of it.
    rows = [torch.linalg.cross(p, q) for p, q in ((b, normal), (normal, t), (t, b))]
    sign = (t * rows[0]).sum(1, keepdim=True).sign()
    local = sign * torch.stack([(direction * row).sum(1) for row in rows], 1)
    local = torch.nn.functional.normalize(local, dim=1, eps=1e-12)
    local = torch.cat([local[:, :2], local[:, 2:].clamp_min(MIN_Z)], 1)
    return torch.nn.functional.normalize(local, dim=1)
