"""What the two lights on a lat-long map, of texels and of lobes, share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace

import torch
from torch import Tensor

from univoxel import envmap
from univoxel.lights import priors, quadrature
from univoxel.lights.base import AbstractLight
from univoxel.records import Occlusion, Surface
from univoxel.sphere import latlong_directions, texel_solid_angles


class LatLongConfig(ABC):
    """What the configurations of both lights have."""

    directions: int  # of the half-sphere, in training, >= 1
    directions_eval: int  # in evaluation, >= 1


class AbstractLatLongLight(AbstractLight):
    """Light from far away, the same for all points: a lat-long map, interpolated bilinearly.

    Gradients go to the map and the materials, not to normals: the map is no smooth function of
    direction.
    """

    traced = True
    config: LatLongConfig

    @property
    @abstractmethod
    def radiance(self) -> Tensor:
        """The map [H, 2 H, 3] that is interpolated, linear, in the axes of
        docs/reference/conventions.md."""

    @property
    def directions(self) -> int:
        return self.config.directions if self.training else self.config.directions_eval

    def incident(self, surface: Surface, wi: Tensor) -> Tensor:
        """Radiance [N, D, 3] from unit directions wi [N, D, 3], the same for all points."""
        return envmap.lookup(envmap.EnvMap(self.radiance), wi)

    def reflected(
        self,
        surface: Surface,
        wo: Tensor,
        occlusion: Occlusion | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Radiance [N, 3] towards wo; no gradient to normals."""
        surface = replace(surface, normal=surface.normal.detach())
        return quadrature.reflected(self, surface, wo, self.directions, occlusion, generator)


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


def finer(level: Tensor, factor: int) -> Tensor:
    """A lat-long map [H, 2 H, C] with `factor` times as many rows and columns, interpolated."""
    around = torch.cat([level[:, -1:], level, level[:, :1]], 1).movedim(2, 0)[None]
    finer = torch.nn.functional.interpolate(around, scale_factor=factor, mode="bilinear")
    return finer[0, :, :, factor:-factor].movedim(0, 2)
