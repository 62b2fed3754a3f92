"""An analytic scene for tests: a sphere with a known look, photographed from around it."""

import math

import torch

from univoxel.camera import Cameras, image_rays

RADIUS = 0.5


def look_at(position: torch.Tensor) -> torch.Tensor:
    """Camera-to-world [3, 4] of a camera at `position` that looks at the origin, +Z up."""
    back = position / position.norm()
    right = torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]), back)
    right = right / right.norm()
    return torch.stack([right, torch.linalg.cross(back, right), back, position], 1)


def cameras_around(views: int, size: int = 32, distance: float = 2.0) -> Cameras:
    """Cameras on a spiral around the origin that see a sphere of radius 0.8 whole."""
    poses = []
    for v in range(views):
        z = 0.9 * (1 - 2 * (v + 0.5) / views)
        phi = v * math.pi * (3 - math.sqrt(5))
        r = math.sqrt(1 - z * z)
        poses.append(look_at(distance * torch.tensor([r * math.cos(phi), r * math.sin(phi), z])))
    focal = torch.full((views, 2), size * distance / 2 / 0.9)
    return Cameras(torch.stack(poses), focal, torch.full((views, 2), size / 2), size, size)


def sphere_normals(cameras: Cameras, view: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Unit normals [H, W, 3] where pixel centres meet the sphere, and the hit mask [H, W]."""
    rays = image_rays(cameras, view)
    b = (rays.origin * rays.direction).sum(1)
    root = b.square() - rays.origin.square().sum(1) + RADIUS**2
    hit = root > 0
    t = -b - root.clamp_min(0).sqrt()
    normal = (rays.origin + t[:, None] * rays.direction) / RADIUS
    shape = (cameras.height, cameras.width)
    return torch.where(hit[:, None], normal, 0.0).reshape(*shape, 3), hit.reshape(shape)
