"""What the two lights on a lat-long map, of texels and of lobes, share."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from univoxel import envmap
from univoxel.lights import priors, quadrature
from univoxel.lights.base import AbstractLight
from univoxel.records import Occlusion, Surface
from univoxel.sphere import latlong_directions, texel_solid_angles


def reflected(
    light: AbstractLight,
    surface: Surface,
    wo: Tensor,  # [N, 3]
    occlusion: Occlusion | None,
    generator: torch.Generator | None,
) -> Tensor:
    """Radiance [N, 3] towards wo, without gradient to normals."""
    surface = replace(surface, normal=surface.normal.detach())
    return quadrature.reflected(light, surface, wo, light.directions, occlusion, generator)


def chroma(radiance: Tensor) -> Tensor:
    """How far from white the light of a map [H, 2 H, 3] is on the whole."""
    height, width, _ = radiance.shape
    share = texel_solid_angles(height, width).to(radiance)[..., None]
    return priors.chroma((radiance * share).sum((0, 1))[None])


def resampled(radiance: Tensor, height: int) -> Tensor:
    """A lat-long map [H, 2 H, 3] at another height; texels are averaged over where it shrinks."""
    if height < len(radiance):
        share = texel_solid_angles(*radiance.shape[:2]).to(radiance)[..., None]
        weight = torch.cat([radiance * share, share], -1).movedim(2, 0)
        pooled = torch.nn.functional.adaptive_avg_pool2d(weight, (height, 2 * height))
        return (pooled[:3] / pooled[3:]).movedim(0, 2)
    return envmap.lookup(envmap.EnvMap(radiance), latlong_directions(height).to(radiance))
