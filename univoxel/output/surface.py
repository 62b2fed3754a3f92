"""The surface of a scene as a clean, closed mesh; parts that no photograph shows are smoothed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.sparse import coo_matrix, csr_matrix, diags
from torch import Tensor
from torch.nn.functional import normalize

from univoxel.camera import Cameras, project
from univoxel.core import log
from univoxel.core.records import Mesh
from univoxel.errors import UserError
from univoxel.ops import VisibilityScene
from univoxel.output.mesh import vertex_normals
from univoxel.output.topology import cleaned
from univoxel.render.observations import MIN_COSINE
from univoxel.run import photos_of
from univoxel.scene import Scene

# Edges over which the border between what is seen and what is not is spread
BORDER = 6
# Rounds of smoothing, and how far of the way to the mean of its neighbours a vertex goes in each
ROUNDS = 24
STEP = 0.6
# Voxels that smoothing moves a vertex at most: thin parts stay, and the field's materials are near
REACH = 1.5
# Of a turn: views one such step apart differ as much as they can
GOLDEN = 0.6180339887


def surface_of(scene: Scene, cameras: Cameras | None = None) -> Mesh:
    """The surface that a scene's mesh is made of: closed, without crumbs and hollows; a NoSurface
    where there is none, or no part of it encloses volume.

    It is closed where the grid's border cuts it, too. Where none of the cameras that were trained
    on, see `cameras_of`, sees it, it is smoothed, and `seen` says so; without cameras it is not.
    """
    mesh, *dropped = cleaned(Mesh(*scene.field.isosurface(closed=True)))
    if any(dropped):
        said = "mesh: left out %d small pieces beside the object and %d hollows inside it"
        log.info(said, *dropped)
    if cameras is None:
        return mesh
    low, high = scene.field.bounds()
    inside = ((mesh.vertices >= low) & (mesh.vertices <= high)).all(1)  # the cap is a guess
    seen = inside & seen_by(mesh, cameras, scene.field.voxel_size)
    mesh = smoothed(mesh, seen, REACH * scene.field.voxel_size)
    assert mesh.seen is not None
    if guess := float((mesh.seen < 0.5).float().mean()):
        log.info("mesh: smoothed the %.1f %% of the surface that no photograph shows", 100 * guess)
    return mesh


def cameras_of(scene: Scene, run: Path) -> Cameras | None:
    """Where the photographs that were trained on were taken; None: they are not there any more."""
    try:
        return scene.registered(photos_of(run, split="train")).cameras
    except (UserError, OSError) as error:
        log.info("mesh: not smoothed, because photographs could not be read: %s", error)
        return None


def seen_by(mesh: Mesh, cameras: Cameras, offset: float) -> Tensor:
    """Which vertices at least one camera sees, not too grazing and with nothing between: [P] bool.

    Args:
        offset: world units that rays start above the surface.
    """
    position, normal = mesh.vertices, vertex_normals(mesh)
    surface = VisibilityScene(mesh.vertices, mesh.faces)
    hidden = torch.arange(len(position))  # from all cameras so far
    # Cameras that differ come first: after a few of them little is left to ask for
    for view in ((GOLDEN * torch.arange(len(cameras)).double()) % 1).argsort().tolist():
        eye = cameras.camera_to_world[view, :, 3]
        towards = normalize(eye - position[hidden], dim=1)
        pixel, depth = project(cameras, view, position[hidden])
        shown = ((pixel > 0) & (pixel < torch.tensor(cameras.size(view)))).all(1) & (depth > 0)
        facing = shown & ((normal[hidden] * towards).sum(1) > MIN_COSINE)
        asked, towards = hidden[facing], towards[facing]
        if not len(asked):
            continue
        start = position[asked] + offset * (normal[asked] + towards)
        reach = float((eye - start).norm(dim=1).max())
        facing[facing.clone()] = ~surface.occluded(start, towards, 0.0, reach)
        hidden = hidden[~facing]
    seen = torch.ones(len(position), dtype=torch.bool)
    seen[hidden] = False
    return seen


def smoothed(mesh: Mesh, seen: Tensor, reach: float) -> Mesh:
    """The mesh smooth where it is not seen [P], moved by at most `reach` world units, with `seen`
    in [0, 1].

    Single vertices count as most around them do. What is seen stays where it is; beyond the border
    vertices are free the more the farther they are, within BORDER edges.
    """
    mean = _mean_of_neighbours(mesh)
    share = seen.double().numpy()
    for _ in range(BORDER):
        share = 0.5 * (share + mean @ share)
    share = np.clip(2 * share, 0, 1)
    free = (1 - share)[:, None]
    start = vertices = mesh.vertices.double().numpy()
    for _ in range(ROUNDS if free.any() else 0):
        moved = vertices + STEP * free * (mean @ vertices - vertices) - start
        length = np.linalg.norm(moved, axis=1, keepdims=True)
        vertices = start + moved * (reach / np.maximum(length, reach))
    vertices, share = (torch.from_numpy(x.astype(np.float32)) for x in (vertices, share))
    return replace(mesh, vertices=vertices, seen=share)


def _mean_of_neighbours(mesh: Mesh) -> csr_matrix:
    """Takes values of vertices to the mean of those that share an edge with each: [P, P]."""
    a, b, c = mesh.faces.long().numpy().T
    row, column = np.concatenate([a, b, c, b, c, a]), np.concatenate([b, c, a, a, b, c])
    count = len(mesh.vertices)
    joined = coo_matrix((np.ones(len(row)), (row, column)), shape=(count, count)).tocsr()
    joined.data[:] = 1  # edges of two faces came twice
    degree = np.maximum(np.asarray(joined.sum(1)).reshape(-1), 1)
    return csr_matrix(diags(1 / degree) @ joined)
