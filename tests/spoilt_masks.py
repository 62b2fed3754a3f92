"""Masks of an object on a table, and what a network may make of them."""

import math

import torch

from univoxel.camera import Cameras, image_rays
from univoxel.capture.masks import BESIDE, MISSING
from univoxel.preparation.stereo import DepthMaps

__all__ = ["BESIDE", "MISSING", "iou", "kept_table", "lost_part", "true_mask", "without_depth"]

BALLS = ((0.0, 0.0, 0.0, 0.4), (0.4, 0.1, 0.1, 0.2))  # centre and radius
TABLE, EDGE = -0.4, 0.7  # height and radius of a round table


def true_mask(cameras: Cameras, view: int) -> torch.Tensor:
    """Two balls, one grown into the other: [H, W], 0 or 1."""
    rays = image_rays(cameras, view)
    hit = torch.zeros(len(rays.origin), dtype=torch.bool)
    for *centre, radius in BALLS:
        away = torch.linalg.cross(torch.tensor(centre) - rays.origin, rays.direction)
        hit |= away.norm(dim=1) < radius
    return hit.reshape(cameras.height, cameras.width).float()


def kept_table(cameras: Cameras, view: int) -> torch.Tensor:
    """The mask with the table that the balls lie on."""
    rays = image_rays(cameras, view)
    t = (TABLE - rays.origin[:, 2]) / rays.direction[:, 2]
    place = rays.origin + t[:, None] * rays.direction
    table = (t > 0) & (place[:, :2].norm(dim=1) < EDGE)
    return torch.maximum(true_mask(cameras, view), table.reshape(true_mask(cameras, view).shape))


def lost_part(mask: torch.Tensor) -> torch.Tensor:
    """The mask without the right third of the object's box."""
    columns = mask.any(0).nonzero()[:, 0]
    spoilt = mask.clone()
    spoilt[:, int(columns[-1]) - (int(columns[-1]) - int(columns[0])) // 3 :] = 0
    return spoilt


def iou(found: torch.Tensor, true: torch.Tensor) -> float:
    """Intersection over union."""
    found, true = found >= 0.5, true >= 0.5
    return float((found & true).sum() / (found | true).sum().clamp_min(1))


def without_depth(cameras: Cameras) -> DepthMaps:
    """Depth maps of photographs in which nothing can be matched."""
    shape = len(cameras), cameras.height, cameras.width
    known = torch.zeros(shape, dtype=torch.bool)
    return DepthMaps(cameras, torch.full(shape, math.nan), known, 0.1)
