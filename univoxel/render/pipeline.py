"""Rays -> samples -> field -> opacity -> one surface per ray -> material -> light."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from univoxel.camera import Cameras, image_rays
from univoxel.ops import composite
from univoxel.records import Mesh, Rays, Surface
from univoxel.render.density import section_alpha
from univoxel.scene import Scene

RAYS_AT_ONCE = 32768  # of pictures: bounds memory


def surface_at(scene: Scene, rays: Rays, jitter: Tensor | None = None) -> Surface:
    """What rays meet. Features are composited and decoded once per ray, not per sample.

    Args:
        jitter: [N] in [0, 1), where in its first step a ray starts; half a step when left out.
    """
    n = len(rays.origin)
    jitter = rays.origin.new_full((n,), 0.5) if jitter is None else jitter
    samples = scene.field.march(rays, jitter, scene.inv_s)
    ray = torch.repeat_interleave(samples.offsets.diff())
    points = torch.addcmul(rays.origin[ray], samples.t[:, None], rays.direction[ray])
    field = scene.field.sample(points)
    alpha = section_alpha(field.sdf, samples.connected, scene.inv_s)
    one = torch.ones_like(alpha)[:, None]
    ends = torch.cat([field.features, field.gradient, samples.t[:, None], one], 1)
    middles = 0.5 * (ends + ends.roll(-1, 0))  # a section's value; where none starts alpha is 0
    total, _ = composite(alpha, middles, samples.offsets)
    opacity = total[:, -1]
    mean = total[:, :-1] / opacity.clamp_min(1e-4)[:, None]
    features, gradient, t = mean.split([scene.field.channels, 3, 1], 1)
    albedo, roughness, *metallic = scene.material(features)
    return Surface(
        position=rays.origin + t * rays.direction,
        normal=torch.nn.functional.normalize(gradient, dim=1, eps=1e-6),
        features=features,
        albedo=albedo,
        roughness=roughness,
        opacity=opacity,
        depth=t[:, 0],
        metallic=metallic[0] if metallic else None,
    )


def at_rays(surface: Surface, index: Tensor) -> Surface:
    """The surface at some of its rays: numbers, or a mask."""
    return _mapped(lambda x: x[index], surface)


def shade(scene: Scene, surface: Surface, wo: Tensor) -> Tensor:
    """Physically based radiance [N, 3] that the surface sends along wo, linear."""
    return scene.light.reflected(surface, wo)


@torch.no_grad()
def shade_hits(scene: Scene, surface: Surface, wo: Tensor) -> Tensor:
    """`shade` where there is a surface, times its opacity: linear radiance on black [N, 3]."""
    rgb = torch.zeros_like(surface.position)
    for index in (surface.opacity > 1e-3).nonzero()[:, 0].split(RAYS_AT_ONCE):
        met = at_rays(surface, index)
        rgb[index] = shade(scene, met, wo[index]) * met.opacity[:, None]
    return rgb


@torch.no_grad()
def surface_of_view(scene: Scene, cameras: Cameras, view: int) -> tuple[Surface, Tensor]:
    """Surface at every pixel of a view, row by row [H * W], and wo [H * W, 3]."""
    rays = image_rays(cameras, view)
    parts = [
        surface_at(scene, Rays(o, d))
        for o, d in zip(
            rays.origin.split(RAYS_AT_ONCE), rays.direction.split(RAYS_AT_ONCE), strict=True
        )
    ]
    return _mapped(lambda *x: torch.cat(x), *parts), -rays.direction


@torch.no_grad()
def extract_mesh(scene: Scene) -> Mesh:
    """The zero level of the field's sdf as triangles, with materials decoded at the vertices.

    Raises:
        ValueError: the sdf has no zero level.
    """
    vertices, faces = scene.field.isosurface()
    parts = []
    for points in vertices.split(RAYS_AT_ONCE):
        sample = scene.field.sample(points)
        normal = torch.nn.functional.normalize(sample.gradient, dim=1, eps=1e-6)
        parts.append((normal, *scene.material(sample.features)))
    return Mesh(vertices, faces, *(torch.cat(p) for p in zip(*parts, strict=True)))


def _mapped(f: Callable[..., Tensor], *surfaces: Surface) -> Surface:
    """f of each tensor of some surfaces; what they do not have stays None."""

    def one(*values: Any) -> Any:
        return None if values[0] is None else f(*values)

    names = vars(surfaces[0])
    return Surface(**{name: one(*(vars(s)[name] for s in surfaces)) for name in names})
