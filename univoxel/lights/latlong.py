"""Distant light on a lat-long map: the common base, and a map on nodes that is solved for."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import replace

import torch
from torch import Tensor, nn

from univoxel import envmap, sphere
from univoxel.core.records import Occlusion, Surface
from univoxel.lights import base, quadrature
from univoxel.lights.base import AbstractLight
from univoxel.sphere import latlong_directions, texel_solid_angles


class AbstractLatLongLight(AbstractLight):
    """Light from far away, the same for all points: a lat-long map, interpolated bilinearly.

    Gradients go to the map and the materials, not to normals: the map is no smooth function of
    direction.
    """

    traced = True

    @property
    @abstractmethod
    def radiance(self) -> Tensor:
        """The map [H, 2 H, 3] that is interpolated, linear, in the axes of
        docs/reference/conventions.md."""

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
    return base.chroma((radiance * share).sum((0, 1))[None])


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


# One distant light for the whole object: an environment map at D nodes, which is solved for.


NODES_AT_ONCE = 8192


class DistantLight(nn.Module):
    """Radiance at D directions of a Fibonacci sphere, 4 pi / D steradians each; kept as logarithm,
    so that it stays positive and a bright sun is as far away as a dark wall.

    Where something polished showed the same map more sharply, its texels lie beside. They serve
    pictures of it, and light for other things.
    """

    direction: Tensor
    sharp: Tensor | None  # [R, 2 R, 3] radiance, linear

    def __init__(self, count: int, radiance: float = 1.0, rows: int = 0) -> None:
        """
        Args:
            rows: R of the texels, 0: there are none.
        """
        super().__init__()
        self.log_radiance: nn.Parameter = nn.Parameter(
            torch.full((count, 3), math.log(radiance))
        )  # [D, 3]
        self.register_buffer("direction", sphere.fibonacci_sphere(count))  # [D, 3]
        self.register_buffer("sharp", torch.zeros(rows, 2 * rows, 3) if rows else None)

    @property
    def radiance(self) -> Tensor:
        """[D, 3] linear."""
        return self.log_radiance.exp()

    def changed(self, log_change: Tensor) -> DistantLight:
        """Another light, whose logarithm is this one's plus [D, 3]; without gradients."""
        light = DistantLight(len(self.direction)).to(self.direction)
        light.log_radiance.data.copy_(self.log_radiance.detach() + log_change.detach())
        return light

    def incident(self, wi: Tensor) -> Tensor:
        """Radiance [M, 3] from unit directions wi [M, 3], interpolated between the nodes.

        Weights are normalised Gaussians about as wide as the nodes lie apart.
        """
        sharpness = len(self.direction) / 5.0
        parts = []
        for w in wi.split(NODES_AT_ONCE):
            parts.append(torch.softmax(sharpness * (w @ self.direction.T), 1) @ self.radiance)
        return torch.cat(parts)

    def latlong(self, height: int) -> Tensor:
        """The map [height, 2 height, 3], linear, in the axes of docs/reference/conventions.md."""
        if self.sharp is not None:
            return resampled(self.sharp, height)
        wi = sphere.latlong_directions(height)
        return self.incident(wi.flatten(0, 1)).reshape(height, 2 * height, 3)
