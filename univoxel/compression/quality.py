"""Quality that a smaller model loses, on rays whose colours the photographs show.

In dB: how much less well held-out pixels are drawn with it, by the physically based render and by
the radiance head; or how far materials move, as if that were an error of the same render.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from univoxel.color import linear_to_srgb
from univoxel.data import Photos
from univoxel.records import Rays, Surface
from univoxel.render.pipeline import radiance_of, shade, surface_at
from univoxel.scene import Scene
from univoxel.training.loop import batch_at

Number = TypeVar("Number", int, float)


class Decoded(NamedTuple):
    """Everything that a scene's networks give along N rays, times opacity."""

    radiance: Tensor  # [N, 3] of the radiance head, sRGB
    physical: Tensor  # [N, 3] physically based render, sRGB
    material: Tensor  # [N, 5] albedo, roughness, metallic


@dataclass(frozen=True)
class ReferenceRays:
    """N rays and the colours that the photographs show there.

    Held-out rays judge what is lost; rays of the training photographs calibrate and probe.
    """

    rays: Rays
    view: Tensor  # [N] int64
    target: Tensor  # [N, 3] sRGB, on black

    @property
    def wo(self) -> Tensor:
        return -self.rays.direction

    def surface(self, scene: Scene) -> Surface:
        """The surface that the rays meet; no gradient."""
        with torch.no_grad():
            return surface_at(scene, self.rays)

    def decode(self, scene: Scene, surface: Surface, features: Tensor) -> Decoded:
        """What the networks make of features [N, C] on a surface."""
        opacity = surface.opacity[:, None]
        albedo, roughness, metallic = scene.material(features)
        surface = replace(
            surface, features=features, albedo=albedo, roughness=roughness, metallic=metallic
        )
        radiance = radiance_of(scene, surface, self.wo, self.view)
        physical = shade(scene, surface, self.wo, view=self.view)
        material = torch.cat([albedo, roughness[:, None], metallic[:, None]], 1)
        return Decoded(
            radiance * opacity,
            linear_to_srgb((physical * opacity).clamp_min(0)),
            material * opacity,
        )

    @torch.no_grad()
    def decoded(self, scene: Scene) -> Decoded:
        """What the scene as it is gives along the rays; no gradient."""
        surface = self.surface(scene)
        return self.decode(scene, surface, surface.features)

    def loss_db(self, before: Decoded, after: Decoded) -> float:
        """Quality that was lost: the largest loss of radiance, physical render and materials."""

        def error(picture: Tensor) -> Tensor:
            return (picture - self.target).square().mean()

        moved = (after.material - before.material).square().mean()
        ratio = [
            error(after.radiance) / error(before.radiance),
            error(after.physical) / error(before.physical),
            1 + moved / error(before.physical),
        ]
        return 10 * torch.stack(ratio).max().log10().item()


def reference_rays(photos: Photos, pixels: Tensor) -> ReferenceRays:
    """The rays of pixels [P, 3] (view, row, column) of the photographs."""
    batch = batch_at(photos, pixels)
    target = linear_to_srgb(batch.color * batch.alpha[:, None])
    return ReferenceRays(batch.rays, batch.view, target)


def random_reference_rays(photos: Photos, pixels: Tensor, count: int) -> ReferenceRays:
    """The rays of `count` of the pixels [P, 3] at most, drawn without replacement."""
    return reference_rays(photos, pixels[torch.randperm(len(pixels))[:count]])


def last_within_limit(
    candidates: Sequence[Number], loss_db: Callable[[Number], float], limit_db: float
) -> Number:
    """The last candidate that loses at most `limit_db`, found by bisection.

    Args:
        candidates: the first costs nothing and is not measured; losses rise from one to the next.
    """
    low, high = 0, len(candidates)
    while high - low > 1:
        middle = (low + high) // 2
        if loss_db(candidates[middle]) <= limit_db:
            low = middle
        else:
            high = middle
    return candidates[low]
