"""Textured meshes: the record that writers share, the texture atlas, baking of a scene's field, and
placement."""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch
from PIL import Image
from scipy.ndimage import distance_transform_edt
from scipy.spatial import KDTree
from torch import Tensor

from univoxel.brdf import metal_or_none
from univoxel.color import linear_to_srgb
from univoxel.core.choices import Origin
from univoxel.core.records import AlbedoNear, FieldSample, Mesh
from univoxel.errors import UserError
from univoxel.fields.field import Field
from univoxel.ops.charts import corner_weights, rasterise, unwrap
from univoxel.scene import Scene

# glTF and USD look along -Z with +Y up, our world has +Z up: (x, y, z) -> (x, z, -y), a quarter
# turn.
Y_UP = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])

FARTHEST = 1000  # sides of an object that a data set's origin may be away: float32 has 7 digits


@dataclass(frozen=True)
class TexturedMesh:
    """Triangles with textures, counter-clockwise seen from outside; a vertex is in one chart.

    Row 0 of a texture is on top, at v = 1. The field's normal at a texel is the unit vector along

        n = x t + y b + z n,  b = t_w cross(n, t)

    where (x, y, z) is the texel of `relief`, and n, t are the vertices' normals and tangents,
    interpolated over the triangle and not normalised: the frame of MikkTSpace.
    """

    vertices: Tensor  # [P, 3] float32, world
    faces: Tensor  # [F, 3] int32
    normals: Tensor  # [P, 3] float32 unit, of the triangles, smooth across them
    tangents: Tensor  # [P, 4] float32: unit, along +u; w is 1, or -1 where the chart is mirrored
    uv: Tensor  # [P, 2] float32 in [0, 1], u to the right and v upwards
    relief: Tensor  # [T, T, 3] float32 unit, z > 0: the normal in the tangent frame
    albedo: Tensor  # [T, T, 3] float32 linear, in [0, 1]; of a metal: its F0
    roughness: Tensor  # [T, T] float32 perceptual, in [0, 1]
    metallic: Tensor | None = None  # [T, T] float32 in [0, 1]; None: no metal anywhere
    seen: Tensor | None = None  # [P] float32 in [0, 1], as in `Mesh`


def texture_pictures(mesh: TexturedMesh) -> dict[str, np.ndarray]:
    """Textures as uint8: albedo [T, T, 3] in sRGB; linear roughness [T, T], metallic [T, T] where
    the mesh has metal, and normal [T, T, 3], 127.5 (n + 1), green +y, upwards in the picture."""
    values = {"albedo": linear_to_srgb(mesh.albedo), "roughness": mesh.roughness}
    values |= {"normal": 0.5 * (mesh.relief + 1)}
    values |= {} if mesh.metallic is None else {"metallic": mesh.metallic}
    return {name: (x.clamp(0, 1) * 255).round().byte().numpy() for name, x in values.items()}


def encoded(picture: np.ndarray, jpeg: int | None) -> bytes:
    """A picture as the bytes of a PNG file, or of a JPEG file of some quality."""
    file = io.BytesIO()
    if jpeg is None:
        Image.fromarray(picture).save(file, format="PNG")
    else:  # 4:4:4: channels of these are no colours
        Image.fromarray(picture).save(file, format="JPEG", quality=jpeg, subsampling=0)
    return file.getvalue()


# A texture over a mesh: the frames of its vertices, and which texel lies where.


def vertex_normals(mesh: Mesh) -> Tensor:
    """Unit normals [P, 3] of the vertices: the mean over their faces, weighted by the angle there.

    Source: Thuermer and Wuethrich 1998.
    """
    corner, index = mesh.vertices.double()[mesh.faces.long()], mesh.faces.long()
    normal = _unit(torch.linalg.cross(*_edges_at(corner, 0)))
    total = torch.zeros(len(mesh.vertices), 3, dtype=torch.float64)
    for k in range(3):
        to_next, to_last = _edges_at(corner, k)
        total.index_add_(0, index[:, k], normal * _angle(to_next, to_last)[:, None])
    return _unit(total).float()


def vertex_tangents(vertices: Tensor, faces: Tensor, normals: Tensor, uv: Tensor) -> Tensor:
    """Tangents [P, 4]: unit along +u, at right angles to the normal, and the sign of b.

    The formula of MikkTSpace (Mikkelsen 2008), which renderers use that compute their own: per
    corner dP/du, projected into the vertex's plane and normalised, weighted by the corner's angle
    in that plane. It differs from MikkTSpace only at vertices where charts of both windings meet,
    which are not split here.
    """
    index = faces.long()
    corner, flat = vertices.double()[index], uv.double()[index]
    (d1, d2), (e1, e2) = _edges_at(flat, 0), _edges_at(corner, 0)
    winding = (d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]).sign()
    along_u = winding[:, None] * (d2[:, 1:] * e1 - d1[:, 1:] * e2)
    total = torch.zeros(len(vertices), 4, dtype=torch.float64)
    for k in range(3):
        n = normals.double()[index[:, k]]
        to_next, to_last = (_unit(_reject(e, n)) for e in _edges_at(corner, k))
        angle = _angle(to_next, to_last)[:, None]
        tangent = torch.cat([_unit(_reject(along_u, n)), winding[:, None]], 1)
        total.index_add_(0, index[:, k], angle * tangent)
    n = normals.double()
    # Where faces have no extent in the texture any direction serves.
    axis = torch.nn.functional.one_hot(n.abs().argmin(1), 3).double()
    tangent = total[:, :3]
    tangent = torch.where(tangent.norm(dim=1, keepdim=True) > 1e-9, tangent, _reject(axis, n))
    sign = torch.where(total[:, 3:] < 0, -1.0, 1.0)
    return torch.cat([_unit(_reject(tangent, n)), sign], 1).float()


def dilated(texel: Tensor, size: int) -> Tensor:
    """For each texel of a picture the nearest of the given ones, as an index into `texel`: [T, T].

    The whole background takes colours from the charts beside it, so that neither filtering nor
    any mip level mixes it in.
    """
    empty = np.ones((size, size), bool)
    empty.reshape(-1)[texel.numpy()] = False
    nearest = distance_transform_edt(empty, return_distances=False, return_indices=True)
    row, column = np.asarray(nearest, np.int64)
    place = np.zeros(size * size, np.int64)
    place[texel.numpy()] = np.arange(len(texel))
    return torch.from_numpy(place[row * size + column])


def _unit(x: Tensor) -> Tensor:
    """x / |x|, and 0 for 0."""
    return torch.nn.functional.normalize(x, dim=1, eps=1e-30)


def _reject(x: Tensor, n: Tensor) -> Tensor:
    """The part of x at right angles to unit n."""
    return x - (x * n).sum(1, keepdim=True) * n


def _edges_at(corner: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """From corner k of triangles [F, 3, C] to the next and to the last one."""
    return corner[:, (k + 1) % 3] - corner[:, k], corner[:, (k + 2) % 3] - corner[:, k]


def _angle(a: Tensor, b: Tensor) -> Tensor:
    """Between vectors, stable for small angles; 0 where one is 0."""
    return torch.atan2(torch.linalg.cross(a, b).norm(dim=1), (a * b).sum(1))


# Reads a scene's field into the vertices or the texture of a mesh that lies near its surface.


POINTS_AT_ONCE = 1 << 17  # bounds memory
NEWTON_STEPS = 4
REACH = 2.0  # voxels: how far a point of the mesh may be moved to meet the field's surface
OFF = 1.0  # voxels of distance from which on a point counts as off the surface
MIN_Z = 0.05  # of a texel's normal in the tangent frame: it looks out of the triangle


def nearest_surface(
    field: Field, points: Tensor, known: KDTree | None = None
) -> tuple[Tensor, FieldSample]:
    """Points [M, 3] moved onto the field's zero level, and the field there.

    Newton steps along the gradient, x - f grad f / |grad f|^2; where they would lead further than
    two voxels away (the mesh cuts a corner, the field is no distance) they end there.

    Args:
        known: points of the zero level, see `surface_beside`. The nearest is in for one that
            ends off it, as on the cap of a surface that the grid's border cuts.
    """
    x, reach = points, REACH * field.voxel_size
    for _ in range(NEWTON_STEPS):
        at = field.sample(x)
        slope = at.gradient.square().sum(1).clamp_min(1e-6)
        moved = x - (at.sdf / slope)[:, None] * at.gradient - points
        length = moved.norm(dim=1, keepdim=True)
        x = points + moved * (reach / length.clamp_min(reach))
    at = field.sample(x)
    off = (at.sdf.abs() > OFF * field.voxel_size).nonzero()[:, 0]
    if known is None or not len(off):
        return x, at
    place = np.asarray(known.data[known.query(points[off].numpy(), workers=-1)[1]], np.float32)
    x = x.index_copy(0, off, torch.from_numpy(place))
    return x, field.sample(x)


def surface_beside(field: Field, mesh: Mesh) -> KDTree | None:
    """Points of the field's zero level beside a mesh's vertices, for a mesh that is smoothed or has
    a cap beyond the grid; None: it is neither, or there are none."""
    low, high = field.bounds()
    beyond = bool(((mesh.vertices < low) | (mesh.vertices > high)).any())
    if mesh.seen is None and not beyond:
        return None
    x, at = nearest_surface(field, mesh.vertices)
    on = x[at.sdf.abs() <= OFF * field.voxel_size]
    return KDTree(on.numpy()) if len(on) else None


@torch.no_grad()
def with_materials(scene: Scene, mesh: Mesh) -> Mesh:
    """A mesh with the field's normal and materials at its vertices, which stay in place.

    Where it is not seen it is smooth, and normals are its own.
    """
    parts, known = [], surface_beside(scene.field, mesh)
    for points in mesh.vertices.split(POINTS_AT_ONCE):
        _, at = nearest_surface(scene.field, points, known)
        normal = torch.nn.functional.normalize(at.gradient, dim=1, eps=1e-6)
        parts.append((normal, *scene.material(at.features)))
    normal, *rest, metallic = (torch.cat(p) for p in zip(*parts, strict=True))
    if mesh.seen is not None:
        smooth = torch.lerp(vertex_normals(mesh), normal, mesh.seen[:, None])
        normal = torch.where(mesh.seen[:, None] < 1, _unit(smooth), normal)
    metal = metal_or_none(metallic)
    return Mesh(mesh.vertices, mesh.faces, normal, *rest, metallic=metal, seen=mesh.seen)


@torch.no_grad()
def bake(
    scene: Scene, mesh: Mesh, size: int, albedo_near: AlbedoNear | None = None
) -> TexturedMesh:
    """Textures of size x size texels for a mesh near the scene's surface; a UserError where no
    texel lies in a triangle.

    Each texel's centre is a point of its triangle; the field at the surface beside it gives normal
    and materials, or `albedo_near` the albedo. So relief that the triangles are too coarse for lies
    in the texture. Texels outside of the charts copy the nearest inside. Where the mesh is not seen
    it is smooth, and has no relief.
    """
    source, faces, uv = unwrap(mesh, size)
    vertices, normals = mesh.vertices[source], vertex_normals(mesh)[source]
    tangents = vertex_tangents(vertices, faces, normals, uv)
    texel, face, barycentric = rasterise(uv, faces, size)
    weight = corner_weights(barycentric)
    if not len(texel):
        raise UserError(
            f"a texture of {size} x {size} is too small for {len(faces)} faces: choose a larger "
            "texture or fewer faces"
        )
    seen = None if mesh.seen is None else mesh.seen[source]
    area = torch.linalg.cross(*_edges_at(mesh.vertices[mesh.faces.long()], 0))
    footprint = float((0.5 * area.norm(dim=1).sum() / len(texel)).sqrt())  # world units
    parts, known = [], surface_beside(scene.field, mesh)
    for some, w in zip(face.split(POINTS_AT_ONCE), weight.split(POINTS_AT_ONCE), strict=True):
        corner = faces[some].long()
        point, n, t = (
            torch.einsum("mk,mkc->mc", w, values[corner])
            for values in (vertices, normals, tangents)
        )
        place, at = nearest_surface(scene.field, point, known)
        relief = in_frame(at.gradient, n, t)
        if seen is not None:
            share, flat = (w * seen[corner]).sum(1)[:, None], torch.tensor([0.0, 0.0, 1.0])
            faded = _unit(torch.lerp(flat.expand_as(relief), relief, share))
            relief = torch.where(share < 1, faded, relief)
        albedo, *others = scene.material(at.features)
        if albedo_near is not None:
            albedo = albedo_near(place, _unit(at.gradient), albedo, footprint)
        parts.append((relief, albedo, *others))
    place = dilated(texel, size)
    *rest, metallic = (torch.cat(p)[place] for p in zip(*parts, strict=True))
    metal = metal_or_none(metallic)
    return TexturedMesh(vertices, faces, normals, tangents, uv, *rest, metallic=metal, seen=seen)


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


# Where an exported mesh lies and how large it is.


AnyMesh = TypeVar("AnyMesh", Mesh, TexturedMesh)


@dataclass(frozen=True)
class Placement:
    """x -> scale turn (x - origin), from the run's world to an exported one."""

    origin: Tensor  # [3] float64, the point of the world that comes to lie at 0
    scale: float
    turn: Tensor | None = None  # [3, 3] float64, a rotation; None: none


def placement_of(
    vertices: Tensor, size: float | None, origin: Origin, moved: np.ndarray | None = None
) -> Placement:
    """What brings the bounding box of vertices [P, 3] to a size and to an origin.

    Args:
        size: the longest side of the box afterwards; None: as it is.
        origin: what comes to lie at 0: "upright" and "world", the data set's origin; "bottom", the
            middle of the box's floor; "centre", the middle of the box.
        moved: how the data set's world was moved to the run's, as in `Photos`, which is undone.

    Raises:
        UserError: the data set's origin is so far away that float32 cannot hold the vertices.
    """
    low, high = vertices.double().amin(0), vertices.double().amax(0)
    middle = (low + high) / 2
    match origin:
        case "bottom":
            at = torch.stack([middle[0], middle[1], low[2]])
        case "centre":
            at = middle
        case _:
            at = torch.zeros_like(middle)
    side = float((high - low).max())
    scale = 1.0 if size is None else size / side
    if moved is None:
        return Placement(at, scale)
    turn, at = torch.from_numpy(moved[:, :3].T.copy()), torch.from_numpy(moved[:, 3].copy())
    if (away := float((middle - at).norm())) > FARTHEST * side:
        raise UserError(
            f"export: with origin=world, the object of size {side:.4g} is {away:.6g} away from the "
            "origin, which is too far for the precision of mesh files: use another origin",
            "origin",
        )
    return Placement(at, scale, turn)


def placed(mesh: AnyMesh, placement: Placement) -> AnyMesh:
    """A mesh brought where a placement says; textures stay."""
    turn = placement.turn

    def turned(vectors: Tensor) -> Tensor:
        return (vectors if turn is None else vectors.double() @ turn.T).float()

    changes = {"vertices": turned(placement.scale * (mesh.vertices.double() - placement.origin))}
    if mesh.normals is not None:
        changes["normals"] = turned(mesh.normals)
    if isinstance(mesh, TexturedMesh):
        along, side = mesh.tangents[:, :3], mesh.tangents[:, 3:]
        changes["tangents"] = torch.cat([turned(along), side], 1)
    return replace(mesh, **changes)
