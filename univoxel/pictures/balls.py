"""A map of light as pictures: itself, and a grey and a mirror ball under it."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from univoxel.envmap import EnvMap, lookup
from univoxel.sphere import latlong_directions, texel_solid_angles

GREY = 0.5  # albedo of the ball
TEXELS = 64  # rows of the map that light is summed over


def map_and_balls(map: Tensor, height: int) -> list[Tensor]:
    """A map, and a grey and a mirror ball under it, seen from +X: linear, `height` rows each."""
    y, z = torch.meshgrid(*2 * [(2 * torch.arange(height) + 1) / height - 1], indexing="xy")
    z = -z
    inside = y * y + z * z < 1
    normal = torch.stack([(1 - y * y - z * z).clamp_min(0).sqrt(), y, z], -1)
    mirrored = 2 * normal[..., :1] * normal - torch.tensor([1.0, 0.0, 0.0])
    light = EnvMap(map)
    grey = grey_ball(map, normal.flatten(0, 1)).view(height, height, 3)
    balls = [torch.where(inside[..., None], b, 0.0) for b in (grey, lookup(light, mirrored))]
    return [lookup(light, latlong_directions(height)), *balls]


def grey_ball(map: Tensor, normal: Tensor) -> Tensor:
    """Radiance [N, 3] of a Lambertian ball of albedo GREY at unit normals [N, 3]."""
    direction, light = summed_light(map)
    return GREY / math.pi * (normal @ direction.T).clamp_min(0) @ light


def summed_light(map: Tensor) -> tuple[Tensor, Tensor]:
    """Directions [M, 3] and radiance times solid angle [M, 3] of a map, pooled to few texels."""
    height, width, _ = map.shape
    rows = min(height, TEXELS)
    light = (map * texel_solid_angles(height, width)[..., None]).movedim(2, 0)
    pooled = adaptive_avg_pool2d(light, (rows, 2 * rows)).flatten(1).T
    return latlong_directions(rows).flatten(0, 1), pooled * (light[0].numel() / len(pooled))
