"""What the photographs show of points of the visual hull."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from univoxel.data import Photos
from univoxel.fields.dense import DenseDistances
from univoxel.grid import GridShape
from univoxel.ops import VisibilityScene
from univoxel.records import Mesh
from univoxel.render.transport import Observations, observe, surface_points


@torch.no_grad()
def observe_hull(photos: Photos, sdf: Tensor, grid: GridShape, points: int) -> Observations | None:
    """Observations of points spread over the hull; None: it has no surface.

    Args:
        photos: their cameras where they are believed to be.
        sdf: [X, Y, Z] of the hull on the grid, world units.
    """
    if not sdf.min() < 0 < sdf.max():
        return None
    field = DenseDistances(grid, sdf)
    vertices, faces = field.isosurface()
    normals = normalize(field.sample(vertices).gradient, dim=1, eps=1e-6)
    mesh = Mesh(vertices, faces, normals)
    spread = surface_points(mesh, points, torch.Generator().manual_seed(0))
    return observe(*spread, photos, VisibilityScene(vertices, faces), grid.voxel_size)
