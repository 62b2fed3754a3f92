"""A semi-global plane sweep below the visual hull: how far pixels see, how views agree there."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor
from torch.nn.functional import normalize

from univoxel.camera import Cameras, image_rays, looked_at, pixel_rays, project, projection_matrices
from univoxel.fields.dense import DenseDistances
from univoxel.grid import GridShape
from univoxel.ops import VisibilityScene, match_cost, semi_global

# Depths along a ray, a voxel apart: deeper concavities are opened as far as this
DEPTHS = 48
# Views that a view's depths come from; as many again check them
NEIGHBOURS = 8
# Of them, views that agree best and count: others are occluded
BEST = 4
# Share of a logarithmic curve in the colours that are compared. Cloth inside of a shoe shows its
# pattern in few steps of 8 bits: dark colours are taken further apart
LOG_SHARE = 2 / 3
# Steepness of that curve: how many times further apart black is taken than with log(1 + x)
LOG_STEEPNESS = 40.0
# Colour difference that a step of one depth between neighbouring pixels costs
SLOPE = 0.0033
# Colour difference that a larger step costs
JUMP = 0.0133


def log_colors(picture: Tensor) -> Tensor:
    """The same picture [H, W, 4] uint8 with dark colours further apart: 0 and 1 stay."""
    coverage = picture[..., 3:] / 255
    color = (picture[..., :3] / 255 / coverage.clamp_min(1e-3)).clamp_max(1)
    logarithm = (LOG_STEEPNESS * color).log1p() / math.log1p(LOG_STEEPNESS)
    color = torch.lerp(color, logarithm, LOG_SHARE) * coverage
    return torch.cat([(255 * color).round().byte(), picture[..., 3:]], 2)


def surface_depths(sdf: Tensor, grid: GridShape, cameras: Cameras) -> Iterator[Tensor]:
    """Distance [H, W] along each pixel's ray to the surface, view after view; infinity: past it,
    or beyond a picture.

    Args:
        sdf: [X, Y, Z] world units.
        grid: of the sdf.
    """
    vertices, triangles = DenseDistances(grid, sdf).isosurface()
    surface = VisibilityScene(vertices, triangles)
    for view in range(len(cameras)):
        stored = torch.full((cameras.height, cameras.width), torch.inf)
        rows, columns = _shown_in(cameras, view, vertices)
        pixel = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1).reshape(-1, 2) + 0.5
        rays = pixel_rays(cameras, torch.tensor(view), pixel)
        distance = surface.closest_hit(rays.origin, rays.direction).t
        stored[rows[:, None], columns] = distance.view(len(rows), len(columns))
        yield stored


def _shown_in(cameras: Cameras, view: int, points: Tensor) -> tuple[Tensor, Tensor]:
    """Rows and columns of a view's pixels, int64, outside of which it shows no point of [P, 3]."""
    width, height = cameras.size(view)
    pixel, depth = project(cameras, view, points)
    if not len(points) or not (depth > 0).all():  # some beside the camera: they may be anywhere
        return torch.arange(height), torch.arange(width)
    low, high = pixel.amin(0).floor().tolist(), pixel.amax(0).ceil().tolist()
    columns, rows = (
        torch.arange(max(0, int(low[i])), max(0, min(n, int(high[i]))))
        for i, n in enumerate((width, height))
    )
    return rows, columns


def depth_maps(
    pictures: Tensor,
    cameras: Cameras,
    hull_depths: list[Tensor],
    hull: Tensor,
    grid: GridShape,
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """View after view: distance along each pixel's ray, and colour difference of views that had no
    say in it, there and on the hull: three [H, W], NaN outside the object.

    What seems to lie beyond the object, as in a flat mirror, is taken for the hull.

    Args:
        pictures: [V, H, W, 4] uint8 from `log_colors`; 0 beyond a picture.
        hull_depths: V, [H, W], from `surface_depths`.
        hull: [X, Y, Z] sdf, world units.
        grid: of the hull.
    """
    field, step = DenseDistances(grid, hull), grid.voxel_size
    matrix = projection_matrices(cameras)
    toward = normalize(cameras.camera_to_world[:, :, 3] - looked_at(cameras), dim=1)
    similarity = (toward @ toward.T).fill_diagonal_(-2.0)
    for view in range(len(cameras)):
        inside = (pictures[view, :, :, 3] >= 128) & hull_depths[view].isfinite()
        rows = torch.where(inside, inside.flatten().cumsum(0).view(inside.shape) - 1, -1)
        rays, hull_depth = image_rays(cameras, view), hull_depths[view][inside]
        inside_picture = cameras.cut(view, inside).flatten()
        origin, direction = rays.origin[inside_picture], rays.direction[inside_picture]
        premultiplied = pictures[view][inside].float()
        color = premultiplied[:, :3] / premultiplied[:, 3:]
        pixel_rays = pictures, matrix, origin, direction
        nearest_views = similarity[view].topk(min(2 * NEIGHBOURS, len(cameras) - 1)).indices

        def difference(start: Tensor, others: Tensor, depths: int) -> Tensor:
            best = min(BEST, len(others))
            return match_cost(*pixel_rays, start, color, rows, others, step, depths, best=best)  # noqa: B023

        cost = difference(hull_depth, nearest_views[::2], DEPTHS)
        depth = hull_depth + step * semi_global(cost, rows, SLOPE, JUMP).argmin(1)
        point = origin + depth[:, None] * direction
        depth = torch.where(field.sample(point).sdf > 0.5 * step, hull_depth, depth)
        maps = torch.full((3, *inside.shape), torch.nan)
        checked = (difference(d, nearest_views[1::2], 1)[:, 0] for d in (depth, hull_depth))
        maps[:, inside] = torch.stack([depth, *checked])
        yield maps[0], maps[1], maps[2]
