"""A texture over a mesh: charts, the frames of its vertices, and which texel lies where."""

from __future__ import annotations

import numpy as np
import torch
import xatlas
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from univoxel.records import Mesh

PADDING = 4  # texels between charts: two mip levels stay apart
CANDIDATES = 1 << 22  # texels looked at together: bounds memory


def unwrap(mesh: Mesh, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """Cut a mesh into charts and pack them into a square of size x size texels (xatlas).

    Returns:
        source [Q] int64, the vertex of `mesh` that each new one copies; faces [F, 3] int32, in the
        order of `mesh`; uv [Q, 2] float32 in [0, 1], v upwards.
    """
    atlas = xatlas.Atlas()
    atlas.add_mesh(mesh.vertices.numpy(), mesh.faces.numpy().astype(np.uint32))
    charts, pack = xatlas.ChartOptions(), xatlas.PackOptions()
    # No mirrored charts, not every program can light them; the packer rotates by a transposition.
    charts.fix_winding, pack.rotate_charts = True, False
    pack.resolution, pack.padding, pack.bilinear = size, PADDING, True
    atlas.generate(charts, pack)
    source, faces, uv = atlas[0]
    return (
        torch.from_numpy(source.astype(np.int64)),
        torch.from_numpy(faces.astype(np.int32)),
        torch.from_numpy(uv.astype(np.float32)).clamp(0, 1),
    )


def vertex_normals(mesh: Mesh) -> Tensor:
    """Unit normals [P, 3] of the vertices: the mean over their faces, weighted by the angle there.

    Source: Thuermer and Wuethrich 1998.
    """
    corner, index = mesh.vertices.double()[mesh.faces.long()], mesh.faces.long()
    normal = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal = _unit(normal)
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
    d1, d2 = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    e1, e2 = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
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


def rasterise(uv: Tensor, faces: Tensor, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """The texels whose centres lie in a triangle.

    Texel (row r, column c) has its centre at u = (c + 0.5) / size, v = 1 - (r + 0.5) / size.

    Returns:
        texel [K] int64 = r * size + c, each once; face [K] int64; barycentric [K, 3] float32.
    """
    corner = uv.double().numpy()[faces.long().numpy()] * [size, -size] + [0, size]
    low = np.ceil(corner.min(1) - 0.5).astype(np.int64).clip(0)
    high = np.floor(corner.max(1) - 0.5).astype(np.int64).clip(None, size - 1)
    extent = (high - low + 1).clip(0)
    count = extent.prod(1)
    owner = np.full(size * size, -1, np.int64)
    weights = np.zeros((size * size, 3), np.float32)
    chunk = (np.cumsum(count) // CANDIDATES) if len(count) else count
    for some in np.split(np.arange(len(count)), np.flatnonzero(np.diff(chunk)) + 1):
        face = np.repeat(some, count[some])
        first = np.repeat(np.cumsum(count[some]) - count[some], count[some])
        row, column = np.divmod(np.arange(len(face)) - first, extent[face, 0])
        column, row = column + low[face, 0], row + low[face, 1]
        a, b, c = corner[face].transpose(1, 0, 2)
        p = np.stack([column, row], 1) + 0.5
        area = _cross(b - a, c - a)
        with np.errstate(divide="ignore", invalid="ignore"):  # triangles without area hold nothing
            wb, wc = _cross(p - a, c - a) / area, _cross(b - a, p - a) / area
        inside = (wb >= 0) & (wc >= 0) & (wb + wc <= 1)
        texel = (row * size + column)[inside]
        owner[texel] = face[inside]
        weights[texel] = np.stack([1 - wb - wc, wb, wc], 1)[inside]
    texel = np.flatnonzero(owner >= 0)
    return torch.from_numpy(texel), torch.from_numpy(owner[texel]), torch.from_numpy(weights[texel])


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


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _unit(x: Tensor) -> Tensor:
    """x / |x|, and 0 for 0."""
    return torch.nn.functional.normalize(x, dim=1, eps=1e-30)


def _reject(x: Tensor, n: Tensor) -> Tensor:
    """The part of x at right angles to unit n."""
    return x - (x * n).sum(1, keepdim=True) * n


def _edges_at(corner: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """From corner k of triangles [F, 3, 3] to the next and to the last one."""
    return corner[:, (k + 1) % 3] - corner[:, k], corner[:, (k + 2) % 3] - corner[:, k]


def _angle(a: Tensor, b: Tensor) -> Tensor:
    """Between vectors, stable for small angles; 0 where one is 0."""
    return torch.atan2(torch.linalg.cross(a, b).norm(dim=1), (a * b).sum(1))
