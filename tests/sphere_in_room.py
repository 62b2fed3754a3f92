"""Photographs without masks of a sphere in a room, and settings that suffice for it."""

from dataclasses import replace

import torch
from analytic import cameras_around, photograph

from univoxel.camera import image_rays
from univoxel.color import linear_to_srgb
from univoxel.data import Photos
from univoxel.segmentation.config import COARSE, FINE, SegmentationConfig

VIEWS, SIZE = 16, 40


def behind(rays, room):
    """Waves of colour, infinitely far or on a sphere of radius `room` around the origin."""
    where = rays.direction
    if room:
        half = (rays.origin * where).sum(1)
        t = (half.square() - rays.origin.square().sum(1) + room**2).sqrt() - half
        where = (rays.origin + t[:, None] * where) / room
    phase = torch.tensor([0.0, 2.0, 4.0])
    return 0.4 + 0.2 * torch.sin(7 * where + phase) + 0.2 * torch.sin(11 * where.roll(1, 1) - phase)


def photographs(tmp_path, room=None) -> Photos:
    cameras = cameras_around(VIEWS, SIZE)
    colors = []
    for view in range(VIEWS):
        color, alpha = photograph(cameras, view)
        back = behind(image_rays(cameras, view), room).reshape(SIZE, SIZE, 3)
        colors.append(alpha[..., None] * color + (1 - alpha[..., None]) * back)
    encoded = (255 * linear_to_srgb(torch.stack(colors))).round().byte()
    whole = torch.full((VIEWS, SIZE, SIZE), 255, dtype=torch.uint8)
    return Photos(tmp_path, [f"r_{v}" for v in range(VIEWS)], encoded, whole, cameras)


def overlap(found, true) -> float:
    """Intersection over union."""
    found, true = found > 0.5, true > 0.5
    return float((found & true).sum() / (found | true).sum())


def short(steps) -> SegmentationConfig:
    """300 steps suffice for a sphere of 20 pixels; 20 leave little more than the ball at first."""
    return SegmentationConfig(
        replace(COARSE, voxels=0.03, iterations=steps, rays=512),
        replace(FINE, voxels=0.06, iterations=steps // 5, rays=1024),
    )
