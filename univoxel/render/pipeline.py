"""Rays -> samples -> field -> opacity -> one surface per ray -> material -> light."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from univoxel import brdf
from univoxel.brdf import metal_or_none
from univoxel.camera import Cameras, image_rays
from univoxel.color import linear_to_srgb_unclipped, srgb_to_linear
from univoxel.core.records import AlbedoNear, Mesh, Occlusion, Rays, Surface
from univoxel.lights.quadrature import half_sphere, rotations
from univoxel.lights.views import rotated
from univoxel.ops import VisibilityScene
from univoxel.scene import Scene


@torch.no_grad()
def occlusion(scene: Scene, surface: Surface, directions: int, rotation: Tensor) -> Occlusion:
    """Trace rays from N points over their half-spheres, D directions each.

    Light that is blocked is replaced by what the scene's radiance head says of the place that
    blocks it, seen from the point: all bounces at once, since the head is fitted to photographs.

    Args:
        directions: D, at least 1.
        rotation: [N] radians that they are turned by about each normal.

    Raises:
        ValueError: the scene has no surface.
    """
    wi = half_sphere(surface, directions, rotation)
    visible, indirect = trace_and_shade(scene, *occlusion_rays(scene, surface, wi))
    return Occlusion(rotation, visible.to(wi.dtype).view(wi.shape[:2]), indirect.view_as(wi))


def occlusion_rays(scene: Scene, surface: Surface, wi: Tensor) -> tuple[Tensor, Tensor]:
    """Rays from N points along wi [N, D, 3]: origins and directions, [N D, 3] each.

    They begin a voxel off the surface: rendered points lie only about on the mesh.
    """
    start = surface.position + scene.field.voxel_size * surface.normal
    return start[:, None].expand_as(wi).reshape(-1, 3), wi.reshape(-1, 3)


@torch.no_grad()
def trace_and_shade(
    scene: Scene, start: Tensor, away: Tensor, tracer: VisibilityScene | None = None
) -> tuple[Tensor, Tensor]:
    """Which of M rays meet nothing [M], and the radiance [M, 3] that comes from what others meet:
    the scene's own surface, or the tracer's mesh."""
    hit = (tracer or scene.occluder()).closest_hit(start, away)
    blocked = (hit.face >= 0).nonzero()[:, 0]
    indirect = torch.zeros_like(away)
    place = start[blocked] + hit.t[blocked, None] * away[blocked]
    indirect[blocked] = outgoing(scene, place, -away[blocked])
    return hit.face < 0, indirect


def outgoing(scene: Scene, points: Tensor, wo: Tensor) -> Tensor:
    """Linear radiance [N, 3] that places [N, 3] on the surface send along wo [N, 3], as seen."""
    sample = scene.field.sample(points)
    normal = normalize(sample.gradient, dim=1, eps=1e-6)
    return srgb_to_linear(scene.radiance(scene.coded(sample.features), normal, wo))


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


def joined(parts: list[Surface]) -> Surface:
    """The surfaces of some rays after another as one."""
    names = [name for name, x in vars(parts[0]).items() if x is not None]
    return Surface(**{name: torch.cat([vars(part)[name] for part in parts]) for name in names})


def in_light_frame(scene: Scene, surface: Surface, wo: Tensor) -> tuple[Surface, Tensor]:
    """The surface's normals and wo [N, 3] as the light sees them, where it turns with the camera.

    Places stay those of the object: what networks know of a point is its own.
    """
    turntable = scene.cfg.turntable
    if turntable is None:
        return surface, wo
    turn = turntable.turn((surface.position + surface.depth[:, None] * wo).detach())
    return replace(surface, normal=rotated(turn, surface.normal)), rotated(turn, wo)


def radiance_of(
    scene: Scene, surface: Surface, wo: Tensor, view: Tensor | int | None = None
) -> Tensor:
    """What the radiance head says that the surface sends along wo [N, 3]: [N, 3], sRGB-encoded;
    view as in `shade`."""
    surface, wo = in_light_frame(scene, surface, wo)
    encoded = scene.radiance(scene.coded(surface.features, view), surface.normal, wo)
    if scene.views is None:
        return encoded
    return linear_to_srgb_unclipped(scene.exposed(srgb_to_linear(encoded), view))


def flashed(scene: Scene, surface: Surface, wo: Tensor) -> Tensor | float:
    """What the scene's flash adds to the radiance [N, 3] of a surface along wo [N, 3]."""
    if scene.flash is None:
        return 0.0
    albedo, f0 = brdf.split(surface.albedo, surface.metallic)
    f0 = f0 if isinstance(f0, Tensor) else torch.full_like(albedo, f0)
    of_surface = albedo, surface.roughness, f0
    return scene.flash.reflected(surface.normal, wo, surface.depth.detach(), *of_surface)


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
    light, from_flash = scene.light, flashed(scene, surface, wo)
    if not light.traced:
        surface, wo = in_light_frame(scene, surface, wo)
        surface = replace(surface, features=scene.coded(surface.features, view))
        rgb = light.reflected(surface, wo, generator=generator)
        if scene.mirrored is not None and not scene.mirrored.silent:
            rgb = (rgb + scene.mirrored(surface, wo, scene.radiance.directions)).clamp_min(0)
        return scene.exposed(rgb + from_flash, view)
    parts = []
    for index in torch.arange(len(wo)).split(max(1, TRACED_AT_ONCE // light.directions)):
        part = at_rays(surface, index)
        seen = occlusion(scene, part, light.directions, rotations(part, generator))
        parts.append(light.reflected(part, wo[index], seen))
    rgb = torch.cat(parts) if parts else torch.zeros_like(wo)
    return scene.exposed(rgb + from_flash, view)


@torch.no_grad()
def shade_hits(scene: Scene, surface: Surface, wo: Tensor, view: int | None = None) -> Tensor:
    """`shade` where there is a surface, times its opacity: linear radiance on black [N, 3]."""
    rgb = torch.zeros_like(surface.position)
    for index in (surface.opacity > 1e-3).nonzero()[:, 0].split(RAYS_AT_ONCE):
        met = at_rays(surface, index)
        rgb[index] = shade(scene, met, wo[index], view=view) * met.opacity[:, None]
    return rgb


@torch.no_grad()
def surface_of_view(
    scene: Scene, cameras: Cameras, view: int, albedo_near: AlbedoNear | None = None
) -> tuple[Surface, Tensor]:
    """Surface at every pixel of a view, row by row [H * W], and wo [H * W, 3]."""
    rays = image_rays(cameras, view)
    parts = [
        surface_at(scene, Rays(o, d))
        for o, d in zip(
            rays.origin.split(RAYS_AT_ONCE), rays.direction.split(RAYS_AT_ONCE), strict=True
        )
    ]
    surface = joined(parts)
    there = surface.opacity > 0
    if albedo_near is not None and there.any():
        footprint = float(surface.depth[there].median() / cameras.focal[view].mean())
        met = at_rays(surface, there)
        surface.albedo[there] = albedo_near(met.position, met.normal, met.albedo, footprint)
    return surface, -rays.direction


@torch.no_grad()
def extract_mesh(scene: Scene) -> Mesh:
    """The zero level of the field's sdf as triangles, with materials decoded at the vertices;
    NoSurface if there is none."""
    vertices, faces = scene.field.isosurface()
    parts = []
    for points in vertices.split(RAYS_AT_ONCE):
        sample = scene.field.sample(points)
        normal = torch.nn.functional.normalize(sample.gradient, dim=1, eps=1e-6)
        parts.append((normal, *scene.material(sample.features)))
    *rest, metallic = (torch.cat(p) for p in zip(*parts, strict=True))
    return Mesh(vertices, faces, *rest, metallic=metal_or_none(metallic))
