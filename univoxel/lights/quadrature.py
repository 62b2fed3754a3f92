"""Reflection of any light by quadrature over the hemisphere or the sphere."""

from __future__ import annotations

import math
from abc import abstractmethod

import torch
from torch import Tensor, nn

from univoxel import brdf, ops, sphere
from univoxel.core.records import Occlusion, Surface
from univoxel.lights import base
from univoxel.lights.base import AbstractLight, AbstractLocalLight, Regularisation


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


def whole_sphere(count: int, generator: torch.Generator | None) -> Tensor:
    """Fibonacci directions [D, 3], 4 pi / D steradians each; with a generator turned as a whole."""
    directions = sphere.fibonacci_sphere(count)
    return directions if generator is None else directions @ sphere.random_rotation(generator).T


def reflected(
    light: AbstractLight,
    surface: Surface,
    wo: Tensor,  # [N, 3]
    directions: int = 128,
    occlusion: Occlusion | None = None,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Radiance [N, 3] towards wo: (2 pi / D) sum_d L(w_d) f(w_d, wo) max(n.w_d, 0).

    Args:
        wo: [N, 3] unit, world, to the eye.
        directions: D >= 1, how many.
        occlusion: makes L of the light's radiance: its open share plus what comes instead.
        generator: turns the directions at random for each point.

    Raises:
        ValueError: an occlusion of another size, or together with a generator: it brings the
            directions that it was found for.

    Differentiable in what the light is, and in the surface; where normal and wo need no gradient
    a compiled op does the sum, many times faster.
    """
    if occlusion is not None:
        n = len(wo)
        for name, wanted in (
            ("rotation", (n,)), ("visibility", (n, directions)), ("indirect", (n, directions, 3))
        ):  # fmt: skip
            shape = getattr(occlusion, name).shape
            if shape != wanted:
                raise ValueError(f"reflected: {name} must be {list(wanted)}, got {list(shape)}")
        if generator is not None:
            raise ValueError("reflected: expected either an occlusion or a generator, got both")
    rotation = rotations(surface, generator) if occlusion is None else occlusion.rotation
    wi = half_sphere(surface, directions, rotation)
    radiance = light.incident(surface, wi)
    if occlusion is not None:
        radiance = occlusion.visibility[..., None] * radiance + occlusion.indirect
    diffuse, f0 = brdf.split(surface.albedo, surface.metallic)
    normal, solid_angle = surface.normal, 2 * math.pi / directions
    if torch.is_grad_enabled() and (normal.requires_grad or wo.requires_grad):
        normal = normal[:, None]
        material = diffuse[:, None], surface.roughness[:, None]
        f0 = f0[:, None] if isinstance(f0, Tensor) else f0
        f = brdf.evaluate(normal, wo[:, None], wi, *material, f0)
        cosine = (normal * wi).sum(-1, keepdim=True).clamp_min(0)
        return solid_angle * (radiance * f * cosine).sum(1)
    # Around its own normal, and turned back, every point has the same directions
    up = torch.zeros_like(normal)
    up[:, 2] = 1
    return ops.shade_radiance(
        radiance,
        up,
        sphere.rotate_z(sphere.to_local(wo, normal), -rotation),
        diffuse,
        surface.roughness,
        sphere.fibonacci_hemisphere(directions, wo.dtype).to(wo.device),
        solid_angle,
        f0,
    )


def reflected_shared(
    light: AbstractLight,
    surface: Surface,
    wo: Tensor,  # [N, 3]
    occlusion: Occlusion | None = None,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Radiance [N, 3] towards wo: (4 pi / D) sum_d L(w_d) f(w_d, wo) max(n.w_d, 0).

    All points share the D = light.directions directions, over the whole sphere, and
    `light.incident` takes them as [D, 3]: what a light does per direction it does D times, not N D
    times. An occlusion goes by the directions around each normal. Differentiable in what the light
    is, and in the surface's normals and materials; not in wo.

    Args:
        generator: turns the directions at random, as a whole.
    """
    if occlusion is not None:
        count = occlusion.visibility.shape[1]
        return reflected(light, surface, wo, count, occlusion, generator)
    directions = whole_sphere(light.directions, generator).to(wo)
    diffuse, f0 = brdf.split(surface.albedo, surface.metallic)
    return ops.shade_radiance(
        light.incident(surface, directions),
        surface.normal,
        wo.detach(),  # cameras that are refined would ask for it
        diffuse,
        surface.roughness,
        directions,
        4 * math.pi / len(directions),
        f0,
    )


_MEAN_OVER = 32  # directions that stand for the whole sphere where light is averaged
START = math.log(math.expm1(0.5))  # softplus makes radiance 1/2 of it


class BasisLight(AbstractLocalLight):
    """Local light as functions of the direction, weighted by coefficients at each point.

        L(x, w) = softplus(coefficients(x) . basis(w))

    All points share the directions, so the basis is evaluated once a direction, and a matrix
    product does the rest. A bare sum swings below zero beside every lamp. Clamped there, it would
    get no gradient and stay dark; softplus is positive, follows the sum where light is bright, and
    lets a dark direction come back. `base` is [B, 3].
    """

    @abstractmethod
    def basis(self, wi: Tensor) -> Tensor:
        """[..., B] of unit directions [..., 3]."""

    def coefficients(self, surface: Surface) -> Tensor:
        """[N, B, 3] at each point."""
        return self.base + self.raw(surface).unflatten(-1, (-1, 3))

    def incident(self, surface: Surface, wi: Tensor) -> Tensor:
        """Radiance [N, D, 3] from unit directions wi [N, D, 3]; or [D, 3], the same for all."""
        return nn.functional.softplus(self.basis(wi) @ self.coefficients(surface))

    def reflected(
        self,
        surface: Surface,
        wo: Tensor,
        occlusion: Occlusion | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Radiance [N, 3] towards wo, summed over the whole sphere."""
        return reflected_shared(self, surface, wo, occlusion, generator)

    def regularisation(self, surface: Surface, near: Surface) -> Regularisation:
        here, beside = self.coefficients(surface), self.coefficients(near)
        wi = sphere.fibonacci_sphere(_MEAN_OVER).to(here)
        light = nn.functional.softplus(self.basis(wi) @ here)
        return Regularisation(
            light_smoothness=base.smoothness(here, beside), white_light=base.chroma(light.mean(1))
        )
