"""A data set that needs next to no model: a ball of one colour under a hemispherical sky.

    python benchmarks/ball.py DIR

40 photographs and 6 test views of 100 x 100 pixels in the NeRF layout, antialiased by 8 x 8 rays.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import torch
from torch import Tensor

from lab.stress.render import name_of
from univoxel.camera import Cameras, image_rays
from univoxel.color import linear_to_srgb
from univoxel.data.images import write_png
from univoxel.data.transforms import write_cameras

SIZE, FINER, DISTANCE, RADIUS = 100, 8, 2.0, 0.5
COLOR = torch.tensor([0.6, 0.4, 0.2])


def cameras(count: int, size: int, turn: float) -> Cameras:
    """On a spiral around the origin, at which they look; +Z is up in the pictures."""
    height = 0.9 * (1 - 2 * (torch.arange(count) + 0.5) / count)
    angle = turn + torch.arange(count) * math.pi * (3 - math.sqrt(5))
    flat = (1 - height.square()).sqrt()
    back = torch.stack([flat * angle.cos(), flat * angle.sin(), height], 1)
    right = torch.stack([-angle.sin(), angle.cos(), torch.zeros(count)], 1)
    up = torch.linalg.cross(back, right)
    poses = torch.stack([right, up, back, DISTANCE * back], 2)
    focal = torch.full((count, 2), 1.1 * size)
    return Cameras(poses, focal, torch.full((count, 2), size / 2), size, size)


def picture(of: Cameras, view: int) -> Tensor:
    """uint8 [SIZE, SIZE, 4] of a view of FINER times as many pixels a side."""
    rays = image_rays(of, view)
    middle = (rays.origin * rays.direction).sum(1)
    root = middle.square() - rays.origin.square().sum(1) + RADIUS**2
    hit = (root > 0).float()
    normal = (rays.origin - (middle + root.clamp_min(0).sqrt())[:, None] * rays.direction) / RADIUS
    sky = 0.5 + 0.5 * normal[:, 2:]  # what a half-sphere of even radiance 1 sends, over pi
    shown = torch.cat([sky * COLOR * hit[:, None], hit[:, None]], 1)
    mean = shown.view(SIZE, FINER, SIZE, FINER, 4).mean((1, 3))
    alpha = mean[..., 3:]
    color = linear_to_srgb(mean[..., :3] / alpha.clamp_min(1e-6))
    return (255 * torch.cat([color, alpha], 2)).round().byte()


def write(folder: Path) -> Path:
    """The data set; what is there is replaced."""
    for split, count, turn in (("train", 40, 0.0), ("test", 6, 0.5)):
        (folder / split).mkdir(parents=True, exist_ok=True)
        write_cameras(folder, split, cameras(count, SIZE, turn), [name_of(v) for v in range(count)])
        fine = cameras(count, SIZE * FINER, turn)
        for view in range(count):
            write_png(folder / split / f"{name_of(view)}.png", picture(fine, view).numpy())
    return folder


if __name__ == "__main__":
    print(write(Path(sys.argv[1])))
