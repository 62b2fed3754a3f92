"""Detection of the object from depth only, without masks or a network.

Cameras look at the object. Planes that all of them and what they look at lie on one side of are
its support, and walls behind it. What is left of the surface and hangs together around the middle
is the object; or, in a box that people gave, all that is left of the surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage
from skimage.measure import label
from torch import Tensor

from univoxel.camera import image_rays, looked_at
from univoxel.fields.grid import GridShape, fit_grid
from univoxel.preparation.object_shape import (
    ROOM,
    VOXELS,
    around,
    box_shown,
    depth_in,
    free_and_surface,
    votes,
)
from univoxel.preparation.stereo import DepthMaps, reach

# Planes that are looked for one after the other, and triples of points that are tried for each
PLANES, TRIALS = 4, 500
# Steps of the depth maps from a plane within which surface belongs to it
THICK = 1.5
# Share of the surface near the middle that a plane has at least
LARGE = 0.08
# Share of the cameras that have to stand before a plane
BEFORE = 0.95
# Distance of a plane from the middle, over `reach`, below which it may be a side of the object
CLEAR = 0.1
# Median distance of a plane's surface from the middle, over `reach`, at least: what is nearer is a
# flat side of the object
WIDE = 0.8
# What counts as near the middle, over `reach`: standard deviation of the weight of surface
NEAR = 0.5
# Nodes of surface that an object has at least
LEAST = 200


@dataclass(frozen=True)
class Plane:
    """normal . x = offset; cameras stand where it is more."""

    normal: Tensor  # [3] unit
    offset: float  # world units

    def height(self, points: Tensor) -> Tensor:
        """Of points [..., 3] above it, world units."""
        return points @ self.normal - self.offset

    def near(self, points: Tensor, step: float) -> Tensor:
        """Which of points [..., 3] lie in it: bool."""
        return self.height(points).abs() < THICK * step


def masks_by_depth(
    maps: DepthMaps, box: Tensor | None = None, keep_table: bool = False
) -> list[Tensor] | None:
    """A mask [h, w] in [0, 1] of each small photograph; None: no object stands out.

    A pixel whose depth nobody knows is what its nearest neighbour with a depth is.

    Args:
        box: [2, 3] lower and upper corner, outside of which there is no object; inside all surface
            is the object's.
        keep_table: whether planes behind it are, too.
    """
    cameras = maps.cameras
    centre, half = looked_at(cameras), ROOM * reach(cameras)
    grid = fit_grid(centre - half, centre + half, VOXELS**3)
    surface = surface_nodes(maps, grid)
    planes = [] if keep_table else background_planes(maps, grid, surface)
    if box is not None:
        grid = fit_grid(box[0], box[1], VOXELS**3)
        surface = surface_nodes(maps, grid)
    part = _part(maps, grid, surface, planes, box)
    if part.sum() < LEAST:
        return None
    grid = around(grid, part, VOXELS**3)  # again, finer
    part = _part(maps, grid, surface_nodes(maps, grid), planes, box)
    if part.sum() < LEAST:
        return None
    masks = [_shown(maps, view, grid, part) for view in range(len(cameras))]
    if box is None:
        return masks
    return [mask * box_shown(cameras, view, box) for view, mask in enumerate(masks)]


def surface_nodes(maps: DepthMaps, grid: GridShape) -> Tensor:
    """Which nodes [X, Y, Z] depth maps have a surface at."""
    sizes = [maps.cameras.size(view) for view in range(len(maps.cameras))]
    found = votes([torch.ones(height, width) for width, height in sizes], maps, grid)
    return free_and_surface(found)[1]


def background_planes(maps: DepthMaps, grid: GridShape, surface: Tensor) -> list[Plane]:
    """The support of the object and walls behind it, the largest first, by RANSAC (Fischler and
    Bolles 1981)."""
    centre, radius = looked_at(maps.cameras), reach(maps.cameras)
    eyes = maps.cameras.camera_to_world[:, :, 3]
    points = grid.nodes()[surface]
    points = points[(points - centre).norm(dim=1) < ROOM * radius]
    count, generator = len(points), torch.Generator().manual_seed(0)
    planes: list[Plane] = []
    for _ in range(PLANES):
        if len(points) < 3:
            break
        a, b, c = points[torch.randint(len(points), (3, TRIALS), generator=generator)]
        normal = torch.linalg.cross(b - a, c - a)
        normal = normal / normal.norm(dim=1, keepdim=True).clamp_min(1e-9)
        offset = (normal * a).sum(1)
        before = eyes @ normal.T > offset
        sign = torch.where(before.float().mean(0) < 0.5, -1.0, 1.0)
        normal, offset = sign[:, None] * normal, sign * offset
        usable = (before == (sign > 0)).float().mean(0) >= BEFORE
        usable &= normal @ centre - offset > CLEAR * radius
        some = points[torch.randperm(len(points), generator=generator)[:4000]]
        near = ((some @ normal.T - offset).abs() < THICK * maps.step).float().mean(0)
        best = int(torch.where(usable, near, -1.0).argmax())
        if not usable[best] or near[best] * len(points) < LARGE * count:
            break
        found = Plane(normal[best], float(offset[best]))
        within = found.near(points, maps.step)
        if (points[within] - centre).norm(dim=1).median() > WIDE * radius:
            planes.append(fitted(points[within], found.normal))
            points = points[planes[-1].height(points) > THICK * maps.step]
        else:
            points = points[~within]
    return planes


def fitted(points: Tensor, up: Tensor) -> Plane:
    """The plane nearest to points [N, 3] in least squares, whose normal looks along up [3]."""
    middle = points.mean(0)
    normal = torch.linalg.svd(points - middle, full_matrices=False)[2][2]
    normal = normal * (normal @ up).sign()
    return Plane(normal, float(normal @ middle))


def _part(
    maps: DepthMaps, grid: GridShape, surface: Tensor, planes: list[Plane], box: Tensor | None
) -> Tensor:
    """The object's nodes [X, Y, Z] of the surface: those in a box, or else around the middle."""
    if box is None:
        return middle_part(maps, grid, surface, planes)
    return before_planes(maps, grid, surface, planes) & (depth_in(grid, box) >= 0)


def before_planes(maps: DepthMaps, grid: GridShape, surface: Tensor, planes: list[Plane]) -> Tensor:
    """The nodes [X, Y, Z] of the surface before all planes."""
    nodes = grid.nodes()
    before = surface.clone()
    for plane in planes:
        before &= plane.height(nodes) > THICK * maps.step
    return before


def middle_part(maps: DepthMaps, grid: GridShape, surface: Tensor, planes: list[Plane]) -> Tensor:
    """The nodes [X, Y, Z] of the surface before all planes that hang together around the middle."""
    nodes, before = grid.nodes(), before_planes(maps, grid, surface, planes)
    parts = np.asarray(label(before.numpy(), connectivity=3))
    away = (nodes - looked_at(maps.cameras)).norm(dim=-1) / (NEAR * reach(maps.cameras))
    weight = np.bincount(parts.ravel(), (-away.square()).exp().numpy().ravel())
    weight[0] = 0.0
    part = (parts == weight.argmax()) & before.numpy()
    return torch.from_numpy(part)


def _shown(maps: DepthMaps, view: int, grid: GridShape, part: Tensor) -> Tensor:
    """Which pixels of a view see a part [X, Y, Z] of the surface: [h, w], 0 or 1."""
    width, height = maps.cameras.size(view)
    rays, known = image_rays(maps.cameras, view), maps.known[view, :height, :width]
    distance = maps.distance[view, :height, :width].reshape(-1).nan_to_num()
    place = rays.origin + distance[:, None] * rays.direction - torch.tensor(grid.origin)
    index = (place / grid.voxel_size).round().long()
    size = torch.tensor(grid.size)
    within = ((index >= 0) & (index < size)).all(1)
    x, y, z = index.clamp_min(0).minimum(size - 1).unbind(1)
    thick = torch.from_numpy(ndimage.binary_dilation(part.numpy()))
    shown = (thick[x, y, z] & within).view(height, width).float()
    if not known.any():
        return torch.zeros(height, width)
    nearest = ndimage.distance_transform_edt(
        ~known.numpy(), return_distances=False, return_indices=True
    )
    row, column = torch.from_numpy(np.asarray(nearest)).long()
    return shown[row, column]
