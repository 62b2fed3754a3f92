"""The light that arrives at a point of a subject's surface, as a small lat-long picture."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from univoxel import envmap as env
from univoxel.color import linear_to_srgb
from univoxel.records import Rays
from univoxel.render.relight import Lighting, relight_surface
from univoxel.sphere import direction_to_latlong, latlong_directions, texel_solid_angles
from univoxel.viewer.subject import Subject, at_hits, surface_along

ROWS = 48  # of the picture: wide enough to see what hides the sky
SAMPLES = 32  # of the light, for what other parts of the object send
BOUNCES = 1


@dataclass(frozen=True)
class Point:
    """A place on the mesh."""

    position: Tensor  # [3] world
    normal: Tensor  # [3] unit, outwards


def point_on_mesh(subject: Subject, ray: Rays) -> Point | None:
    """Where one ray first meets the mesh; None: nowhere."""
    hit = subject.traced.visibility.closest_hit(ray.origin, ray.direction)
    mesh = subject.traced.mesh
    if hit.face[0] < 0:
        return None
    assert mesh.normals is not None
    normal = torch.nn.functional.normalize(at_hits(mesh, hit, mesh.normals)[0], dim=0)
    return Point(ray.origin[0] + hit.t[0] * ray.direction[0], normal)


@torch.no_grad()
def incident_light(
    subject: Subject, point: Point, lighting: Lighting, rows: int = ROWS, samples: int = SAMPLES
) -> Tensor:
    """Radiance that arrives at a point from everywhere, linear: [rows, 2 rows, 3].

    Texels are directions as of environment maps. From where the mesh is in the way comes what that
    part of it reflects; from below the horizon comes nothing. A sun is a texel of its irradiance.
    Point lights are left out.
    """
    direction = latlong_directions(rows).reshape(-1, 3)
    above = direction @ point.normal > 0
    light = torch.zeros_like(direction)
    way = direction[above]
    start = (point.position + subject.traced.offset * point.normal).expand_as(way).contiguous()
    surface, wo, hit = surface_along(subject, Rays(start, way))
    far = env.background(lighting.tables, way)
    other = relight_surface(surface, wo, subject.traced, lighting, samples=samples, bounces=BOUNCES)
    light[above] = torch.where((hit.face >= 0)[:, None], other, far)
    light = light.reshape(rows, 2 * rows, 3)
    solid_angle = texel_solid_angles(rows, 2 * rows)
    for sun in lighting.suns:
        towards = torch.nn.functional.normalize(torch.tensor(sun.direction), dim=0)
        if towards @ point.normal <= 0:
            continue
        if subject.traced.visibility.occluded(start[:1], towards[None])[0]:
            continue
        u, v = direction_to_latlong(towards).tolist()
        row, column = min(int(v * rows), rows - 1), int(u * 2 * rows) % (2 * rows)
        light[row, column] += torch.tensor(sun.irradiance) / solid_angle[row, column]
    return light


def incident_picture(light: Tensor, exposure: float, scale: int = 3) -> Tensor:
    """Light as sRGB, each texel `scale` pixels wide: [H, W, 3] in [0, 1]."""
    picture = linear_to_srgb(2**exposure * light).clamp(0, 1)
    return picture.repeat_interleave(scale, 0).repeat_interleave(scale, 1)
