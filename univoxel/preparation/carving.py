"""Hollows that no silhouette shows, such as of cups: opened where photographs agree on them.

Depths come from a semi-global plane sweep below the visual hull. What lies in front of them for
most views is taken away, if photographs that had no say agree too, and if every silhouette stays
covered: what a mirror shows lies behind it for all views, yet without the mirror its outline is
missing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import torch
from scipy import ndimage
from skimage import measure
from torch import Tensor
from torch.nn.functional import avg_pool2d, normalize

from univoxel.camera import Cameras, image_rays, looked_at, project
from univoxel.color import linear_to_srgb
from univoxel.data import Photos
from univoxel.fields.dense import DenseDistances
from univoxel.grid import GridShape
from univoxel.ops import VisibilityScene, match_cost, semi_global

STEPS = 48  # depths along a ray, a voxel apart
OTHERS, BEST = 8, 4  # views that a view is compared with, and those that count
# Dark colours are taken several times as far apart as bright ones: cloth inside of a shoe shows its
# pattern in few steps of 8 bits
DARK_SHARE, DARK = 2 / 3, 40.0
SLOPE, JUMP = 0.0033, 0.0133  # of these, a step of one depth or of more between neighbours
BEHIND = 2.5  # voxels behind a depth up to which its view has a say
AGREE = 0.6  # share of the views with a say that see through what is taken away ...
LEAST = 0.2  # ... and of all views: fewer may see a lamp in something glossy
BETTER = 0.1  # share of a pixel's disagreement that has to go with it ...
VISIBLE = 0.0007  # ... and how much at least: a third of a step of 8 bits where it is bright
ENOUGH = 0.25  # share of the pixels that see through for which it does ...
AROUND = 2.0  # ... within so many voxels
PIECE = 5e-4  # share of the hull that a hollow has at least
ROUNDS = 3  # in which silhouettes are covered again


@torch.no_grad()
def hollowed(hull: Tensor, grid: GridShape, pictures: Tensor, cameras: Cameras) -> Tensor:
    """The SDF of a visual hull with hollows open, where photographs agree on them.

    Args:
        hull: [X, Y, Z] world units, negative inside.
        grid: of the hull.
        pictures: [V, H, W, 4] uint8 sRGB colours times coverage, and coverage.
        cameras: V, of the pictures' size; three or more, or nothing is opened.

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
    start = list(_first_met(hull, grid, cameras))
    free, say, better = torch.zeros(3, len(nodes))
    apart = torch.stack([_stretched(picture) for picture in pictures])
    for view, (depth, found, at_hull) in enumerate(
        _depth_maps(apart, cameras, start, DenseDistances(grid, hull))
    ):
        away, pixel = _seen(nodes, cameras, view)
        before = depth.flatten()[pixel] - away  # NaN: the view says nothing
        through = before > 0
        free += through
        say += before > -BEHIND * grid.voxel_size
        gained = at_hull - found > (BETTER * at_hull).clamp_min(VISIBLE)
        better += through & gained.flatten()[pixel]
    agreed = (free > AGREE * say) & (free > LEAST * len(cameras))

    def around(values: Tensor) -> Tensor:
        spread = torch.zeros(hull.shape).masked_scatter(solid, torch.where(agreed, values, 0.0))
        return torch.from_numpy(ndimage.gaussian_filter(spread.numpy(), AROUND))[solid]

    agreed &= around(better) > ENOUGH * around(free)
    taken = torch.zeros_like(solid).masked_scatter(solid, agreed)
    covered = pictures[..., 3] > 0.9 * 255
    for _ in range(ROUNDS):
        taken = _large(taken, ~solid, PIECE * len(nodes))
        if not taken.any():
            return hull
        crossed = torch.zeros(len(nodes), dtype=torch.bool)
        for view, met in enumerate(_first_met(_without(taken, hull, grid), grid, cameras)):
            lost = covered[view] & start[view].isfinite() & met.isinf()
            if lost.any():
                crossed |= lost.flatten()[_seen(nodes, cameras, view)[1]]
        if not (crossed & taken[solid]).any():
            break
        taken[solid] &= ~crossed
    return _without(_large(taken, ~solid, PIECE * len(nodes)), hull, grid)


def _stretched(picture: Tensor) -> Tensor:
    """The same [H, W, 4] with dark colours further apart: 0 and 1 stay."""
    coverage = picture[..., 3:] / 255
    color = (picture[..., :3] / 255 / coverage.clamp_min(1e-3)).clamp_max(1)
    dark = (DARK * color).log1p() / math.log1p(DARK)
    color = torch.lerp(color, dark, DARK_SHARE) * coverage
    return torch.cat([(255 * color).round().byte(), picture[..., 3:]], 2)


def _first_met(sdf: Tensor, grid: GridShape, cameras: Cameras) -> Iterator[Tensor]:
    """How far [H, W] pixels see to the surface, view after view; infinity: past it."""
    surface = VisibilityScene(*DenseDistances(grid, sdf).isosurface())
    for view in range(len(cameras)):
        rays = image_rays(cameras, view)
        met = surface.closest_hit(rays.origin, rays.direction).t
        yield met.view(cameras.height, cameras.width)


def _depth_maps(
    pictures: Tensor, cameras: Cameras, start: list[Tensor], hull: DenseDistances
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """View after view: how far its pixels see, and how badly views that had no say in that agree
    there, and on the hull: three [H, W], NaN outside the object. What seems to lie beyond it, as in
    a flat mirror, is taken for the hull."""
    step = hull.voxel_size
    matrix = _projections(cameras)
    toward = normalize(cameras.camera_to_world[:, :, 3] - looked_at(cameras), dim=1)
    alike = (toward @ toward.T).fill_diagonal_(-2.0)
    for view in range(len(cameras)):
        inside = (pictures[view, :, :, 3] >= 128) & start[view].isfinite()
        rows = torch.where(inside, inside.flatten().cumsum(0).view(inside.shape) - 1, -1)
        rays, met = image_rays(cameras, view), start[view][inside]
        color = pictures[view][inside].float()
        of_pixels = color[:, :3] / color[:, 3:], rows
        lines = pictures, matrix, rays.origin[inside.flatten()], rays.direction[inside.flatten()]
        near = alike[view].topk(min(2 * OTHERS, len(cameras) - 1)).indices

        def disagreement(at: Tensor, others: Tensor, steps: int) -> Tensor:
            best = min(BEST, len(others))
            return match_cost(*lines, at, *of_pixels, others, step, steps, best=best)  # noqa: B023

        total = semi_global(disagreement(met, near[::2], STEPS), rows, SLOPE, JUMP)
        depth = met + step * total.argmin(1)
        seen = rays.origin[inside.flatten()] + depth[:, None] * rays.direction[inside.flatten()]
        depth = torch.where(hull.sample(seen).sdf > 0.5 * step, met, depth)
        maps = torch.full((3, *inside.shape), torch.nan)
        maps[:, inside] = torch.stack(
            [depth, *(disagreement(at, near[1::2], 1)[:, 0] for at in (depth, met))]
        )
        yield maps[0], maps[1], maps[2]


def _seen(points: Tensor, cameras: Cameras, view: int) -> tuple[Tensor, Tensor]:
    """How far away points [P, 3] are from a camera, and the number of the pixel that shows them;
    of points outside the picture, the nearest one's."""
    pixel, _ = project(cameras, view, points)
    column = pixel[:, 0].floor().clamp(0, cameras.width - 1).long()
    row = pixel[:, 1].floor().clamp(0, cameras.height - 1).long()
    away = (points - cameras.camera_to_world[view, :, 3]).norm(dim=1)
    return away, row * cameras.width + column


def _large(taken: Tensor, outside: Tensor, least: float) -> Tensor:
    """The pieces of it that are open to the outside and large: others are left to training."""
    label = np.asarray(measure.label((taken | outside).numpy(), connectivity=1))
    reached = taken & torch.from_numpy(np.isin(label, np.unique(label[outside.numpy()])))
    piece = np.asarray(measure.label(reached.numpy(), connectivity=1))
    return reached & torch.from_numpy((np.bincount(piece.ravel()) >= least)[piece])


def _without(taken: Tensor, hull: Tensor, grid: GridShape) -> Tensor:
    """The hull's SDF without some of its nodes; as it was, away from them."""
    solid = ((hull <= 0) & ~taken).numpy()
    away, into = (np.asarray(ndimage.distance_transform_edt(s)) for s in (~solid, solid))
    # The surface lies halfway between nodes; half a voxel's blur takes the steps off
    distance = ndimage.gaussian_filter(np.where(solid, 0.5 - into, away - 0.5), 0.7)
    near = torch.from_numpy(ndimage.binary_dilation(taken.numpy(), iterations=3))
    sdf = torch.from_numpy(distance).float() * grid.voxel_size
    return torch.where(near, torch.maximum(hull, sdf), hull)


def _projections(cameras: Cameras) -> Tensor:
    """World to (x z, y z, z) of pixels: [V, 3, 4]."""
    pose = cameras.camera_to_world
    turn = pose[:, :, :3].transpose(1, 2) * torch.tensor([1.0, -1.0, -1.0])[:, None]
    local = torch.cat([turn, -turn @ pose[:, :, 3:]], 2)  # x right, y down, z away
    lens = torch.zeros(len(pose), 3, 3)
    lens[:, 0, 0], lens[:, 1, 1] = cameras.focal.unbind(1)
    lens[:, :2, 2], lens[:, 2, 2] = cameras.centre, 1.0
    return lens @ local


VIEWS = 100  # photographs at most that say what is hollow


PIXEL_SECONDS = 1e-5  # that a pixel of the object takes, about, on two cores


def opened(
    hull: Tensor, grid: GridShape, photos: Photos, gains: Tensor | None, seconds: float
) -> Tensor:
    """The sdf [X, Y, Z] of a hull with its hollows open, or the hull: see `hollowed`.

    Args:
        hull: [X, Y, Z] sdf of the visual hull, world units.
        grid: of the hull.
        photos: V, their cameras where they are believed to be.
        gains: [V] log gains of their exposures.
        seconds: that it may take; where more are expected the hull stays as it is.
    """
    views, factor = _samples(photos.cameras, grid.voxel_size)
    pixels = int(photos.alpha[views].count_nonzero()) / factor**2
    if PIXEL_SECONDS * pixels > seconds:
        return hull
    return hollowed(hull, grid, *pictures_of(photos, grid.voxel_size, gains))


def pictures_of(
    photos: Photos, voxel_size: float, gains: Tensor | None = None
) -> tuple[Tensor, Cameras]:
    """Photographs and cameras as `hollowed` takes them: some, with pixels between half a voxel and
    a voxel wide where the photographs' are narrower, and without their log gains [V]."""
    views, factor = _samples(photos.cameras, voxel_size)
    pictures = []
    for view in views.tolist():
        color, alpha = photos.picture(view)
        if gains is not None:
            color = color / gains[view].exp()
        premultiplied = torch.cat([linear_to_srgb(color) * alpha[..., None], alpha[..., None]], 2)
        shrunk = avg_pool2d(premultiplied.permute(2, 0, 1), factor)
        pictures.append((255 * shrunk.permute(1, 2, 0)).round().byte())
    height, width = pictures[0].shape[:2]
    whole = photos.cameras
    pose, focal, centre = whole.camera_to_world[views], whole.focal[views], whole.centre[views]
    return torch.stack(pictures), Cameras(pose, focal / factor, centre / factor, width, height)


def _samples(cameras: Cameras, voxel_size: float) -> tuple[Tensor, int]:
    """Which views [K] are looked at, and how many pixels make one along a side."""
    views = torch.arange(0, len(cameras), -(-len(cameras) // VIEWS))
    away = (cameras.camera_to_world[:, :, 3] - looked_at(cameras)).norm(dim=1)
    pixel = float((away / cameras.focal.mean(1)).median())
    return views, max(1, int(voxel_size / pixel))
