"""Rays -> samples -> field -> opacity -> one surface per ray -> material -> light."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from univoxel.brdf import metal_or_none
from univoxel.camera import Cameras, image_rays
from univoxel.color import linear_to_srgb_unclipped, srgb_to_linear
from univoxel.lights.quadrature import rotations
from univoxel.records import Mesh, Rays, Surface
from univoxel.render.occlusion import occlusion
from univoxel.scene import Scene

RAYS_AT_ONCE = 32768  # of pictures: bounds memory
TRACED_AT_ONCE = 2**20  # rays towards light: likewise


def surface_at(scene: Scene, rays: Rays, jitter: Tensor | None = None) -> Surface:
    """What rays meet. Features are composited and decoded once per ray, not per sample.

    Args:
        jitter: [N] in [0, 1), where in its first step a ray starts; half a step when left out.
    """
    n = len(rays.origin)
    jitter = rays.origin.new_full((n,), 0.5) if jitter is None else jitter
    samples = scene.field.march(rays, jitter, scene.inv_s)
    along = scene.field.composite(rays, samples, scene.inv_s)
    weight = along.opacity.clamp_min(1e-4)[:, None]
    features, t = along.features / weight, along.t[:, None] / weight
    albedo, roughness, metallic = scene.material(features)
    return Surface(
        position=rays.origin + t * rays.direction,
        normal=torch.nn.functional.normalize(along.gradient, dim=1, eps=1e-6),
        features=features,
        albedo=albedo,
        roughness=roughness,
        opacity=along.opacity,
        depth=t[:, 0],
        metallic=metallic,
    )


def at_rays(surface: Surface, index: Tensor) -> Surface:
    """The surface at some of its rays: numbers, or a mask."""
    return Surface(**{name: x[index] for name, x in vars(surface).items() if x is not None})


def in_light_frame(scene: Scene, surface: Surface, wo: Tensor) -> tuple[Surface, Tensor]:
    """The surface's normals and wo [N, 3] as the light sees them, where it turns with the camera.

    Places stay those of the object: what networks know of a point is its own.
    """
    turntable = scene.cfg.turntable
    if turntable is None:
        return surface, wo
    turn = turntable.turn((surface.position + surface.depth[:, None] * wo).detach())
    normal = turntable.into_light(surface.normal, turn)
    return replace(surface, normal=normal), turntable.into_light(wo, turn)


def radiance_of(
    scene: Scene, surface: Surface, wo: Tensor, view: Tensor | int | None = None
) -> Tensor:
    """What the radiance head says that the surface sends along wo: [N, 3], sRGB-encoded.

    Args:
        wo: [N, 3] unit, towards the eye.
        view: as of `shade`.
    """
    surface, wo = in_light_frame(scene, surface, wo)
    encoded = scene.radiance(scene.coded(surface.features, view), surface.normal, wo)
    if scene.views is None:
        return encoded
    return linear_to_srgb_unclipped(scene.exposed(srgb_to_linear(encoded), view))


def shade(
    scene: Scene,
    surface: Surface,
    wo: Tensor,
    generator: torch.Generator | None = None,
    view: Tensor | int | None = None,
) -> Tensor:
    """Physically based radiance [N, 3] that the surface sends along wo, linear.

    Args:
        generator: turns the directions that light is taken from at random.
        view: [N] photographs in whose light and exposure it stands, or one for all, where they
            differ; None: those that the scene shows.
    """
    light = scene.light
    if not light.traced:
        surface, wo = in_light_frame(scene, surface, wo)
        surface = replace(surface, features=scene.coded(surface.features, view))
        rgb = light.reflected(surface, wo, generator=generator)
        if scene.mirrored is not None and not scene.mirrored.silent:
            rgb = (rgb + scene.mirrored(surface, wo, scene.radiance.directions)).clamp_min(0)
        return scene.exposed(rgb, view)
    parts = []
    for index in torch.arange(len(wo)).split(max(1, TRACED_AT_ONCE // light.directions)):
        part = at_rays(surface, index)
        seen = occlusion(scene, part, light.directions, rotations(part, generator))
        parts.append(light.reflected(part, wo[index], seen))
    return scene.exposed(torch.cat(parts) if parts else torch.zeros_like(wo), view)


@torch.no_grad()
def shade_hits(scene: Scene, surface: Surface, wo: Tensor, view: int | None = None) -> Tensor:
    """`shade` where there is a surface, times its opacity: linear radiance on black [N, 3]."""
    rgb = torch.zeros_like(surface.position)
    for index in (surface.opacity > 1e-3).nonzero()[:, 0].split(RAYS_AT_ONCE):
        met = at_rays(surface, index)
        rgb[index] = shade(scene, met, wo[index], view=view) * met.opacity[:, None]
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
    names = [name for name, x in vars(parts[0]).items() if x is not None]
    whole = {name: torch.cat([vars(part)[name] for part in parts]) for name in names}
    return Surface(**whole), -rays.direction


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
    *rest, metallic = (torch.cat(p) for p in zip(*parts, strict=True))
    return Mesh(vertices, faces, *rest, metallic=metal_or_none(metallic))
