"""Depth maps of all photographs by multi-view stereo: a plane sweep, semi-global matching, and a
check that neighbouring views see the same surface."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from univoxel.camera import (
    Cameras,
    image_rays,
    looked_at,
    project,
    projection_matrices,
    resize,
    stacked,
)
from univoxel.color import linear_to_srgb
from univoxel.core.memmap import parallel_map
from univoxel.data import Photos
from univoxel.ops import match_cost, semi_global

# Pixels of the longer side of the photographs that are compared
PIXELS = 224
# Depths along a ray: two pixels apart or so, which is less than a pixel in a neighbouring view
DEPTHS = 80
# Radius of the ball in which a surface is looked for, over `reach`
BALL = 1.3
# Views that a view is compared with, and of them those that count: others may be occluded
NEIGHBORS = 4
BEST = 2
# Degrees between the directions of two views: what is compared at best, and the range beyond which
# it is not
ANGLE, LEAST_ANGLE, MOST_ANGLE = 15.0, 4.0, 45.0
# Pixels; standard deviation of the window in which brightness is made independent of exposure
WINDOW = 2.5
# Brightness differences (of its logarithm) below which a window counts as without texture
FLAT = 0.05
# Largest difference of a pixel that counts, of 1
MOST = 0.12
# Differences that a step of one depth, and a larger one, between neighbouring pixels cost
SLOPE, JUMP = 0.002, 0.02
# Differences that count as the same, and the share of depths above which a pixel that has the least
# of them has no texture that could be matched
SAME, PLAIN = 0.005, 0.15
# Steps between depths of two views that agree, at most
AGREE = 1.5
# Neighbours that have to agree on a depth
AGREEING = 2


@dataclass(frozen=True)
class DepthMaps:
    """Where each pixel of small photographs sees a surface."""

    cameras: Cameras  # V, of the small photographs
    distance: Tensor  # [V, H, W] float32 along the rays, world units; NaN outside of the ball
    known: Tensor  # [V, H, W] bool: there is texture, and neighbouring views agree
    step: float  # between depths, world units


def reach(cameras: Cameras) -> float:
    """Half the side of the cube around what cameras look at that half of them show whole."""
    away = (cameras.camera_to_world[:, :, 3] - looked_at(cameras)).norm(dim=1)
    tangent = cameras.size_of_each().amin(1) / (2 * cameras.focal.max(1).values)
    return float((away * tangent / (1 + tangent.square()).sqrt()).median())


@torch.no_grad()
def depth_maps(photos: Photos) -> DepthMaps:
    """Depth maps of photographs whose cameras are right; masks are not asked.

    Source: Hirschmueller 2005, "Accurate and efficient stereo processing by semi-global matching";
    depths that views share as in Schoenberger et al. 2016, "Pixelwise view selection for
    unstructured multi-view stereo".
    """
    small, cameras = small_photographs(photos)
    pictures = stacked(parallel_map(comparable, small))
    centre, radius = looked_at(cameras), BALL * reach(cameras)
    step, matrix = 2 * radius / DEPTHS, projection_matrices(cameras)
    compared = views_to_compare(cameras)
    distance = torch.full(pictures.shape[:3], math.nan)
    textured = torch.zeros(pictures.shape[:3], dtype=torch.bool)
    for view, others in enumerate(compared):
        if not len(others):
            continue
        width, height = cameras.size(view)
        rays = image_rays(cameras, view)
        towards = centre - rays.origin
        along = (towards * rays.direction).sum(1)
        hits = towards.square().sum(1) - along.square() < radius**2
        pixels = hits.view(height, width)
        rows = torch.full(pictures.shape[1:3], -1)
        rows[:height, :width] = torch.where(pixels, hits.cumsum(0).view(height, width) - 1, -1)
        origin, direction = rays.origin[hits], rays.direction[hits]
        start = (towards[hits].norm(dim=1) - radius).clamp_min(step)
        color = pictures[view, :height, :width][pixels][:, :3].float() / 255
        cost = match_cost(
            pictures,
            matrix,
            *(origin, direction, start, color, rows, others),
            *(step, DEPTHS),
            most=MOST,
            radius=2,
            best=min(BEST, len(others)),
        )
        depth = start + step * lowest(semi_global(cost, rows, SLOPE, JUMP))
        distance[view, :height, :width][pixels] = depth
        alike = (cost < cost.amin(1, keepdim=True) + SAME).float().mean(1)
        textured[view, :height, :width][pixels] = alike < PLAIN
    maps = DepthMaps(cameras, distance, textured, step)
    agreed = [agreeing(maps, view, others) >= AGREEING for view, others in enumerate(compared)]
    return replace(maps, known=textured & torch.stack(agreed))


def small_photographs(photos: Photos) -> tuple[list[Tensor], Cameras]:
    """Photographs [h, w, 3] in sRGB, and their cameras, as `small_cameras` has them."""
    cameras = small_cameras(photos.cameras)

    def small(view: int) -> Tensor:
        color, _ = photos.stored(view)
        encoded = color.float() / 255 if color.dtype == torch.uint8 else linear_to_srgb(color)
        width, height = cameras.size(view)
        pixels = interpolate(encoded.movedim(2, 0)[None], (height, width), mode="area")
        return pixels[0].movedim(0, 2)

    return parallel_map(small, range(len(photos))), cameras


def small_cameras(cameras: Cameras) -> Cameras:
    """The same views in pictures of at most PIXELS."""
    share = min(1.0, PIXELS / max(cameras.width, cameras.height))
    return resize(cameras, max(2, round(share * cameras.width)))


def comparable(picture: Tensor) -> Tensor:
    """A photograph [H, W, 3] sRGB as `match_cost` takes it, [H, W, 4] uint8: brightness less its
    mean and over its deviation nearby, and shares of red and blue. Exposure takes part in none."""
    color = picture.numpy()
    brightness = np.log(color @ np.array([0.3, 0.6, 0.1], np.float32) + 0.02)
    mean = ndimage.gaussian_filter(brightness, WINDOW)
    square = ndimage.gaussian_filter(np.square(brightness), WINDOW)
    deviation = np.sqrt(np.maximum(square - np.square(mean), 0))
    texture = 0.5 + 0.2 * (brightness - mean) / (deviation + FLAT)
    total = color.sum(-1) + 0.1
    red, blue = (0.25 + 0.75 * color[..., i] / total for i in (0, 2))
    channels = np.stack([texture, red, blue, np.ones_like(red)], -1)
    return torch.from_numpy((255 * channels.clip(0, 1)).round().astype(np.uint8))


def views_to_compare(cameras: Cameras) -> list[Tensor]:
    """For each view those, [M <= NEIGHBORS] int64, that look from beside it."""
    toward = normalize(cameras.camera_to_world[:, :, 3] - looked_at(cameras), dim=1)
    angle = torch.rad2deg((toward @ toward.T).clamp(-1, 1).acos())
    spread = torch.where(angle < ANGLE, ANGLE / 3, ANGLE)
    score = -((angle - ANGLE) / spread).square()
    score[(angle < LEAST_ANGLE) | (angle > MOST_ANGLE)] = -math.inf
    return [
        order[: int((scores > -math.inf).sum().clamp_max(NEIGHBORS))]
        for scores, order in zip(score, score.argsort(1, descending=True), strict=True)
    ]


def lowest(cost: Tensor) -> Tensor:
    """Where costs [N, K] are least, between steps by a parabola: [N]."""
    at = cost.argmin(1, keepdim=True).clamp(1, cost.shape[1] - 2)
    before, here, after = (cost.gather(1, at + i)[:, 0] for i in (-1, 0, 1))
    bend = (before - 2 * here + after).clamp_min(1e-6)
    return at[:, 0] + ((before - after) / (2 * bend)).clamp(-0.5, 0.5)


def agreeing(maps: DepthMaps, view: int, others: Tensor) -> Tensor:
    """How many of other views see what a view's pixels see, where they see it: [H, W]."""
    cameras = maps.cameras
    width, height = cameras.size(view)
    rays, depth = image_rays(cameras, view), maps.distance[view, :height, :width].reshape(-1)
    points = rays.origin + depth.nan_to_num()[:, None] * rays.direction
    count = torch.zeros(maps.distance.shape[1:], dtype=torch.uint8)
    for other in others.tolist():
        row, column, seen = pixels_of(cameras, other, points)
        away = (points - cameras.camera_to_world[other, :, 3]).norm(dim=1)
        apart = (maps.distance[other][row, column] - away).abs()
        agrees = seen & (apart < AGREE * maps.step) & depth.isfinite()
        count[:height, :width] += agrees.view(height, width)
    return count


def pixels_of(cameras: Cameras, view: int, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Row and column, [P] int64 each, of the pixels that show points [P, 3], the nearest ones
    beside the picture; and whether it shows them: [P] bool."""
    pixel, depth = project(cameras, view, points)
    width, height = cameras.size(view)
    column, row = (pixel[:, i].nan_to_num(-1).floor() for i in (0, 1))
    seen = (depth > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return row.clamp(0, height - 1).long(), column.clamp(0, width - 1).long(), seen
