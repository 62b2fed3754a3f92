"""What stands behind the object: pictures on spheres around it, for photographs without masks."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import grid_sample, pad

from univoxel.records import Rays

SHELLS = 6  # spheres, each twice as wide as the one inside it; the last is infinitely far
SIZE = 96, 192  # latitudes, longitudes
CLEAR = -3.0  # logit of a shell's opacity at first


class Backdrop(nn.Module):
    """Concentric spheres with colour and opacity, seen from inside the outermost.

    Each ray meets the far side of every sphere that it passes through; what lies between the camera
    and the object is not modelled. Spheres at different distances move against each other as a room
    does (multi-sphere images, Attal et al. 2020).
    """

    def __init__(self, centre: Tensor, radius: float) -> None:
        """
        Args:
            centre, radius: [3], of the innermost sphere.
        """
        super().__init__()
        self.centre = centre
        self.radii: list[float] = [radius * 2.0**k for k in range(SHELLS - 1)]
        self.color: nn.Parameter = nn.Parameter(
            torch.zeros(SHELLS, 3, *SIZE)
        )  # logits, sRGB-encoded
        self.opaque: nn.Parameter = nn.Parameter(torch.full((SHELLS - 1, 1, *SIZE), CLEAR))

    def forward(self, rays: Rays) -> Tensor:
        """sRGB-encoded colour [N, 3] behind everything."""
        origin, direction = rays.origin - self.centre, rays.direction
        half = (origin * direction).sum(1)
        nearest = origin.square().sum(1) - half.square()  # to the centre, squared
        places, met = [], []
        for radius in self.radii:
            depth = radius**2 - nearest
            t = depth.clamp_min(0).sqrt() - half
            places.append((origin + t[:, None] * direction) / radius)
            met.append((depth > 0) & (t > 0))
        places.append(direction)
        color = torch.sigmoid(looked_up(self.color, torch.stack(places)))  # [K, N, 3]
        alpha = torch.sigmoid(looked_up(self.opaque, torch.stack(places[:-1])))[..., 0]
        alpha = torch.cat([alpha * torch.stack(met), torch.ones_like(half)[None]])
        clear = torch.cumprod(1 - alpha[:-1], 0)
        weight = alpha * torch.cat([torch.ones_like(half)[None], clear])
        return (weight[..., None] * color).sum(0)


def looked_up(texture: Tensor, direction: Tensor) -> Tensor:
    """Bilinear values [K, N, C] of lat-long textures [K, C, H, W] in unit directions [K, N, 3]."""
    width = texture.shape[3]
    around = torch.atan2(direction[..., 1], direction[..., 0]) / math.pi  # [-1, 1]
    up = torch.asin(direction[..., 2].clamp(-1, 1)) / (math.pi / 2)
    wrapped = pad(texture, (1, 1, 0, 0), mode="circular")
    where = torch.stack([around * width / (width + 2), up], -1)[:, None]
    found = grid_sample(wrapped, where, align_corners=False, padding_mode="border")
    return found[:, :, 0].transpose(1, 2)
