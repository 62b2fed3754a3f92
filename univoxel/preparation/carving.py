"""Space carving of concavities that no silhouette shows, with depths from a plane sweep."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import torch
from scipy import ndimage
from skimage import measure
from torch import Tensor
from torch.nn.functional import avg_pool2d, normalize

from univoxel.camera import (
    Cameras,
    image_rays,
    looked_at,
    pixel_rays,
    pixel_width,
    project,
    projection_matrices,
    sizes_of,
    stacked,
)
from univoxel.color import linear_to_srgb
from univoxel.data import Photos
from univoxel.fields.distances import DenseDistances
from univoxel.fields.grid import GridShape
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


def depths_below_hull(
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


# Space carving of concavities that no silhouette shows, such as in cups.
#
# Depths come from a semi-global plane sweep below the visual hull. A node of the hull is carved
# where
#
# - `agree` of the views with a say see through it, and `least` of all views do;
# - views that had no say in the depths agree `better` on them than on the hull, for `enough` of the
#   pixels around;
# - it belongs to a `piece` that is open to the outside;
# - every silhouette stays covered without it. What a mirror shows lies behind it for all views, yet
#   without the mirror its outline is missing.


# Photographs that are used, at most: for time
VIEWS = 100
# Seconds that a pixel of the object takes, about, on two cores
PIXEL_SECONDS = 6e-6
# Voxels behind a view's depth up to which it has a say on nodes
BEHIND = 2.5
# Share of the views with a say, above which a node is carved that they see through
AGREE = 0.6
# Share of all views above which it is: fewer may see a lamp in something glossy
LEAST = 0.2
# Share of a pixel's disagreement on the hull by which the depth has to be better
BETTER = 0.1
# Colour difference by which it has to be better at least: a third of a step of 8 bits where it is
# bright
VISIBLE = 0.0007
# Share of the pixels that see through a node above which the depth has to be better
ENOUGH = 0.25
# Voxels around a node within which that share is taken
AROUND = 2.0
# Share of the hull's nodes that a concavity has at least: smaller ones are left to training
PIECE = 5e-4
# Rounds in which nodes are put back whose absence uncovers a silhouette
ROUNDS = 3


COVERED = 0.9 * 255  # coverage above which a pixel shows the object only


@torch.no_grad()
def carve_concavities(
    hull: Tensor,
    grid: GridShape,
    pictures: Tensor,
    cameras: Cameras,
) -> Tensor:
    """The SDF of a visual hull without the concavities that photographs agree on.

    Args:
        hull: [X, Y, Z] world units, negative inside.
        grid: of the hull.
        pictures: [V, H, W, 4] uint8 sRGB colours times coverage, and coverage; 0 beyond a picture.
        cameras: V, of the pictures' sizes; three or more, or nothing is carved.

    Returns:
        [X, Y, Z], at least hull.

    Source: depths as in Hirschmueller 2005, "Accurate and efficient stereo processing by
    semi-global matching"; what views see through as in Kutulakos and Seitz 2000, "A theory of shape
    by space carving".
    """
    solid = hull <= 0
    if len(cameras) < 3 or not solid.any() or solid.all():
        return hull
    nodes = grid.nodes()[solid]
    hull_depths = list(surface_depths(hull, grid, cameras))
    agreed = _agreed_nodes(hull, grid, pictures, cameras, hull_depths)
    carved = torch.zeros_like(solid).masked_scatter(solid, agreed)
    covered = pictures[..., 3] > COVERED
    min_nodes = PIECE * len(nodes)
    for _ in range(ROUNDS):
        carved = _open_pieces(carved, ~solid, min_nodes)
        if not carved.any():
            return hull
        crossed = torch.zeros(len(nodes), dtype=torch.bool)
        for view, depth in enumerate(surface_depths(_without(carved, hull, grid), grid, cameras)):
            uncovered = covered[view] & hull_depths[view].isfinite() & depth.isinf()
            if uncovered.any():
                crossed |= uncovered.flatten()[_distance_and_pixel(nodes, cameras, view)[1]]
        if not (crossed & carved[solid]).any():
            break
        carved[solid] &= ~crossed
    return _without(_open_pieces(carved, ~solid, min_nodes), hull, grid)


def _agreed_nodes(
    hull: Tensor,
    grid: GridShape,
    pictures: Tensor,
    cameras: Cameras,
    hull_depths: list[Tensor],
) -> Tensor:
    """Which nodes [N] inside the hull the views agree to see through."""
    solid = hull <= 0
    nodes = grid.nodes()[solid]
    free_votes, votes, better_votes = torch.zeros(3, len(nodes))
    colors = torch.stack([log_colors(picture) for picture in pictures])
    maps = depths_below_hull(colors, cameras, hull_depths, hull, grid)
    for view, (depth, error, hull_error) in enumerate(maps):
        distance, pixel = _distance_and_pixel(nodes, cameras, view)
        clearance = depth.flatten()[pixel] - distance  # NaN: the view says nothing
        seen_through = clearance > 0
        free_votes += seen_through
        votes += clearance > -BEHIND * grid.voxel_size
        better = hull_error - error > (BETTER * hull_error).clamp_min(VISIBLE)
        better_votes += seen_through & better.flatten()[pixel]
    agreed = (free_votes > AGREE * votes) & (free_votes > LEAST * len(cameras))

    def around(values: Tensor) -> Tensor:
        volume = torch.zeros(hull.shape).masked_scatter(solid, torch.where(agreed, values, 0.0))
        return torch.from_numpy(ndimage.gaussian_filter(volume.numpy(), AROUND))[solid]

    return agreed & (around(better_votes) > ENOUGH * around(free_votes))


def _distance_and_pixel(points: Tensor, cameras: Cameras, view: int) -> tuple[Tensor, Tensor]:
    """Distance of points [P, 3] from a camera, and number of the stored pixel that shows them; of
    points outside the picture, the nearest one's: [P], [P]."""
    pixel, _ = project(cameras, view, points)
    width, height = cameras.size(view)
    column = pixel[:, 0].floor().clamp(0, width - 1).long()
    row = pixel[:, 1].floor().clamp(0, height - 1).long()
    distance = (points - cameras.camera_to_world[view, :, 3]).norm(dim=1)
    return distance, row * cameras.width + column


def _open_pieces(carved: Tensor, outside: Tensor, min_nodes: float) -> Tensor:
    """The pieces [X, Y, Z] of the carved nodes that are open to the outside and large."""
    label = np.asarray(measure.label((carved | outside).numpy(), connectivity=1))
    reached = carved & torch.from_numpy(np.isin(label, np.unique(label[outside.numpy()])))
    piece = np.asarray(measure.label(reached.numpy(), connectivity=1))
    return reached & torch.from_numpy((np.bincount(piece.ravel()) >= min_nodes)[piece])


def _without(carved: Tensor, hull: Tensor, grid: GridShape) -> Tensor:
    """The hull's SDF without the carved nodes; as it was, away from them."""
    solid = ((hull <= 0) & ~carved).numpy()
    outside, inside = (np.asarray(ndimage.distance_transform_edt(s)) for s in (~solid, solid))
    # The surface lies halfway between nodes; half a voxel's blur takes the steps off
    distance = ndimage.gaussian_filter(np.where(solid, 0.5 - inside, outside - 0.5), 0.7)
    near_carved = torch.from_numpy(ndimage.binary_dilation(carved.numpy(), iterations=3))
    sdf = torch.from_numpy(distance).float() * grid.voxel_size
    return torch.where(near_carved, torch.maximum(hull, sdf), hull)


def carve_within_time(
    hull: Tensor,
    grid: GridShape,
    photos: Photos,
    gains: Tensor | None,
    seconds: float,
) -> Tensor:
    """The SDF [X, Y, Z] of `carve_concavities`, or the hull where that would take too long.

    Args:
        hull: [X, Y, Z] sdf of the visual hull, world units.
        grid: of the hull.
        photos: V, their cameras where they are believed to be.
        gains: [V] log gains of their exposures.
        seconds: that it may take; where more are expected the hull stays as it is.
    """
    views, factor = _views_and_factor(photos.cameras, grid.voxel_size)
    pixels = int(photos.alpha[views].count_nonzero()) / factor**2
    if PIXEL_SECONDS * pixels > seconds:
        return hull
    pictures, cameras = carving_pictures(photos, grid.voxel_size, gains)
    return carve_concavities(hull, grid, pictures, cameras)


def carving_pictures(
    photos: Photos, voxel_size: float, gains: Tensor | None = None
) -> tuple[Tensor, Cameras]:
    """Photographs and cameras as `carve_concavities` takes them: VIEWS of them at most, without
    their log gains [V]. Their pixels are between half a voxel and a voxel wide, where those of the
    photographs are narrower."""
    views, factor = _views_and_factor(photos.cameras, voxel_size)
    pictures = []
    for view in views.tolist():
        color, alpha = photos.picture(view)
        if gains is not None:
            color = color / gains[view].exp()
        premultiplied = torch.cat([linear_to_srgb(color) * alpha[..., None], alpha[..., None]], 2)
        shrunk = avg_pool2d(premultiplied.permute(2, 0, 1), factor)
        pictures.append((255 * shrunk.permute(1, 2, 0)).round().byte())
    chosen, sizes = photos.cameras.of(views), sizes_of([(p.shape[1], p.shape[0]) for p in pictures])
    cameras = Cameras(chosen.camera_to_world, chosen.focal / factor, chosen.centre / factor, *sizes)
    return stacked(pictures), cameras


def _views_and_factor(cameras: Cameras, voxel_size: float) -> tuple[Tensor, int]:
    """Which views [K] are used, and how many pixels make one along a side."""
    views = torch.arange(0, len(cameras), -(-len(cameras) // VIEWS))
    return views, max(1, int(voxel_size / pixel_width(cameras, looked_at(cameras))))
