"""Reflection of any light, by quadrature over the half-sphere."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from univoxel import brdf, sphere
from univoxel.lights.base import AbstractLight
from univoxel.records import Surface


def rotations(
    surface: Surface, generator: torch.Generator | None
) -> Tensor:  # [N] radians in [0, 2 pi)
    """One turn about the normal a point: random with a generator, else 0."""
    if generator is None:
        return torch.zeros_like(surface.roughness)
    turn = torch.rand(surface.roughness.shape, generator=generator, device=generator.device)
    return (2 * math.pi * turn).to(surface.roughness)


def half_sphere(surface: Surface, count: int, rotation: Tensor) -> Tensor:
    """Fibonacci directions [N, D, 3] in the world around each normal, 2 pi / D steradians each.

    The set is turned by rotation [N] about +Z, then put into sphere.frame of the normal.
    """
    local = sphere.fibonacci_hemisphere(count, surface.normal.dtype).to(surface.normal.device)
    return sphere.to_world(
        sphere.rotate_z(local, rotation[:, None].detach()), surface.normal[:, None]
    )


def reflected(
    light: AbstractLight,
    surface: Surface,
    wo: Tensor,  # [N, 3]
    directions: int = 128,
    visibility: Tensor | None = None,  # [N, D]
    generator: torch.Generator | None = None,
) -> Tensor:
    """Radiance [N, 3] towards wo: (2 pi / D) sum_d V_d L(w_d) f(w_d, wo) max(n.w_d, 0).

    Args:
        wo: [N, 3] unit, world, to the eye.
        directions: D >= 1, how many.
        visibility: [N, D] share of the light that arrives, for half_sphere's directions without
            rotation.
        generator: turns the directions at random for each point.

    Raises:
        ValueError: visibility of another shape, or together with a generator: it belongs to
            directions that are not turned.
    """
    if visibility is not None:
        wanted = (len(wo), directions)
        if visibility.shape != wanted:
            raise ValueError(
                f"reflected: visibility must be {list(wanted)}, got {list(visibility.shape)}"
            )
        if generator is not None:
            raise ValueError("reflected: visibility needs fixed directions, got a generator too")
    wi = half_sphere(surface, directions, rotations(surface, generator))
    radiance = light.incident(surface, wi)
    if visibility is not None:
        radiance = radiance * visibility[..., None]
    normal = surface.normal[:, None]
    f = brdf.evaluate(normal, wo[:, None], wi, surface.albedo[:, None], surface.roughness[:, None])
    cosine = (normal * wi).sum(-1, keepdim=True).clamp_min(0)
    return (2 * math.pi / directions) * (radiance * f * cosine).sum(1)
