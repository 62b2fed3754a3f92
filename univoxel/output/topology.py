"""Clean-up, closing and decimation of exported meshes.

Functions take and give the geometry only, and what is seen of it where that is known; what else a
mesh carries at its vertices is dropped.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import fast_simplification
import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from univoxel.core.records import Mesh
from univoxel.errors import NoSurface, UserError

WELD = 1e-3  # of the mean edge: vertices closer than this become one
CRUMB = 0.01  # of the largest component's area: smaller components are dropped


def clean(mesh: Mesh) -> Mesh:
    """Weld coincident vertices, drop degenerate and double faces, crumbs and inner voids; a
    NoSurface where nothing is left.

    A component stays if it has at least a hundredth of the largest one's area and encloses volume
    with its faces outwards: what bounds a void inside the object is never seen.
    """
    return cleaned(mesh)[0]


def cleaned(mesh: Mesh) -> tuple[Mesh, int, int]:
    """As `clean`, and how many components were dropped: small ones beside the object; hollows
    inside it, and open ones without volume."""
    vertices, faces = mesh.vertices.double().numpy(), mesh.faces.long().numpy()
    crumbs = voids = 0
    if len(faces):
        faces = _without_degenerate(_welded(vertices, faces))
    if len(faces):
        faces, crumbs, voids = _component_faces(vertices, faces)
    if not len(faces):
        raise NoSurface("the surface has no part that encloses a volume")
    used, index = np.unique(faces, return_inverse=True)
    seen = None if mesh.seen is None else mesh.seen[torch.from_numpy(used)]
    return _mesh(vertices[used], index.reshape(-1, 3), seen), crumbs, voids


def simplify(mesh: Mesh, faces: int) -> Mesh:
    """The mesh with about `faces` triangles at most, by collapsing edges of least quadric error.

    Source: Garland and Heckbert 1997, in the form of the library fast-simplification.
    """
    if len(mesh.faces) <= faces:
        return Mesh(mesh.vertices, mesh.faces, seen=mesh.seen)
    vertices, index = fast_simplification.simplify(
        mesh.vertices.double().numpy(), mesh.faces.numpy(), target_count=faces
    )[:2]
    reduced = clean(_mesh(vertices, index))
    if mesh.seen is None:
        return reduced
    nearest = KDTree(mesh.vertices.numpy()).query(reduced.vertices.numpy(), workers=-1)[1]
    return replace(reduced, seen=mesh.seen[torch.from_numpy(nearest)])


def close(mesh: Mesh) -> Mesh:
    """Fill every hole by a fan of triangles around the mean of its border; a UserError where edges
    of more than two faces, or of faces that disagree about the outside, leave no closed surface."""
    vertices, faces = mesh.vertices.double().numpy(), mesh.faces.long().numpy()
    edges = _edges(faces)
    border = edges[~np.isin(_keys(edges), _keys(edges[:, ::-1]))]  # with none the other way round
    loops = _loops(border.tolist())
    for loop in loops:
        fan = [[b, a, len(vertices)] for a, b in pairwise([*loop, loop[0]])]
        faces = np.concatenate([faces, fan])
        vertices = np.concatenate([vertices, vertices[loop].mean(0, keepdims=True)])
    seen = None if mesh.seen is None else torch.cat([mesh.seen, torch.zeros(len(loops))])
    mesh = _mesh(vertices, faces, seen)
    if bad := open_edges(mesh):
        raise UserError(f"the mesh cannot be closed: {bad} edges do not join exactly two faces")
    return mesh


def open_edges(mesh: Mesh) -> int:
    """How many directed edges do not meet exactly one in the other direction; 0: watertight."""
    edges = _edges(mesh.faces.long().numpy())
    key, count = np.unique(_keys(edges), return_counts=True)
    return int((count > 1).sum() + (~np.isin(key, _keys(edges[:, ::-1]))).sum())


def _mesh(vertices: np.ndarray, faces: np.ndarray, seen: torch.Tensor | None = None) -> Mesh:
    return Mesh(
        torch.from_numpy(np.ascontiguousarray(vertices, np.float32)),
        torch.from_numpy(np.ascontiguousarray(faces, np.int32)),
        seen=seen,
    )


def _edges(faces: np.ndarray) -> np.ndarray:
    """Directed edges [3 F, 2]."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def _keys(edges: np.ndarray) -> np.ndarray:
    return edges[:, 0] << 32 | edges[:, 1]


def _loops(edges: list[list[int]]) -> list[list[int]]:
    """Loops that pass each of their vertices once, together of all directed edges that form any."""
    onward: dict[int, list[int]] = {}
    for a, b in edges:
        onward.setdefault(a, []).append(b)
    loops = []
    for start in onward:
        path = [start]
        while onward.get(path[-1]):
            b = onward[path[-1]].pop()
            if b in path:
                at = path.index(b)
                loops.append(path[at:])
                del path[at + 1 :]
            else:
                path.append(b)
    return loops


def _welded(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b = vertices[_edges(faces)].transpose(1, 0, 2)
    cell = WELD * np.linalg.norm(b - a, axis=1).mean()
    rounded = np.round(vertices / max(cell, 1e-30)).astype(np.int64)
    _, first, group = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    return first[group.reshape(-1)][faces]


def _without_degenerate(faces: np.ndarray) -> np.ndarray:
    """Faces of three different vertices; of two that coincide one goes, of two back to back both.

    Faces that are thin but have three vertices stay: without them there would be a crack.
    """
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    rank = faces.argsort(1)
    even = (rank[:, 1] - rank[:, 0]) % 3 == 1  # the way round, once the corners are sorted
    corners = np.sort(faces, 1)
    _, first, group = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    balance = np.zeros(len(first), int)
    np.add.at(balance, group.reshape(-1), np.where(even, 1, -1))
    first = first[balance != 0]
    return faces[np.sort(first)]


def _component_faces(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, int, int]:
    """Faces of the components that `clean` keeps; how many it drops, as `cleaned` has them."""
    edges, size = _edges(faces), len(vertices)
    graph = coo_matrix((np.ones(len(edges), bool), edges.T), shape=(size, size))
    count, label = connected_components(graph, directed=False)
    label = label[faces[:, 0]]
    corners = vertices[faces]
    # About each component's own middle: then also an open one has a volume that means something.
    middle = np.zeros((count, 3))
    np.add.at(middle, label, corners.mean(1))
    middle /= np.maximum(np.bincount(label, minlength=count), 1)[:, None]
    a, b, c = (corners - middle[label][:, None]).transpose(1, 0, 2)
    area = np.bincount(label, np.linalg.norm(np.cross(b - a, c - a), axis=1), count)
    volume = np.bincount(label, (a * np.cross(b, c)).sum(1), count)
    small, hollow = area < CRUMB * area.max(), volume <= 0
    there = area > 0  # other numbers are of vertices without a face
    crumbs, voids = int((there & small & ~hollow).sum()), int((there & hollow).sum())
    return faces[~(small | hollow)[label]], crumbs, voids
