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
BLOCK = 64  # normals at a time: what each gets of every texel stays in the cache


def map_and_balls(map: Tensor, height: int) -> list[Tensor]:
    """A map, and a grey and a mirror ball under it, seen from +X: linear, `height` rows each."""
    normal, inside = _ball(height)
    grey = torch.zeros(height, height, 3)
    grey[inside] = grey_ball(map, normal[inside])
    return [lookup(EnvMap(map), latlong_directions(height)), grey, mirror_ball(map, height)]


def mirror_ball(map: Tensor, height: int) -> Tensor:
    """A ball [height, height, 3] that mirrors a map, seen from +X: linear, black around it."""
    normal, inside = _ball(height)
    mirrored = 2 * normal[..., :1] * normal - torch.tensor([1.0, 0.0, 0.0])
    return torch.where(inside[..., None], lookup(EnvMap(map), mirrored), 0.0)


def grey_ball(map: Tensor, normal: Tensor) -> Tensor:
    """Radiance [N, 3] of a Lambertian ball of albedo GREY at unit normals [N, 3]."""
    direction, light = summed_light(map)
    reached = [(part @ direction.T).clamp_min_(0) @ light for part in normal.split(BLOCK)]
    return GREY / math.pi * torch.cat(reached)


def _ball(height: int) -> tuple[Tensor, Tensor]:
    """Normals [height, height, 3] of a ball seen from +X, and where it is [height, height]."""
    y, z = torch.meshgrid(*2 * [(2 * torch.arange(height) + 1) / height - 1], indexing="xy")
    depth = 1 - y * y - z * z
    return torch.stack([depth.clamp_min(0).sqrt(), y, -z], -1), depth > 0


def summed_light(map: Tensor) -> tuple[Tensor, Tensor]:
    """Directions [M, 3] and radiance times solid angle [M, 3] of a map, pooled to few texels."""
    height, width, _ = map.shape
    rows = min(height, TEXELS)
    light = (map * texel_solid_angles(height, width)[..., None]).movedim(2, 0)
    pooled = adaptive_avg_pool2d(light, (rows, 2 * rows)).flatten(1).T
    return latlong_directions(rows).flatten(0, 1), pooled * (light[0].numel() / len(pooled))
