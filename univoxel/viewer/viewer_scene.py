"""The contents of the viewer: scene, mesh with materials, photographs, and the light at a point."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from univoxel import envmap as env
from univoxel.camera import Cameras
from univoxel.color import linear_to_srgb
from univoxel.core.records import Mesh, Rays, Surface
from univoxel.data import Photos
from univoxel.errors import UserError
from univoxel.evaluation.confidence import POINTS, ExpectedErrors, survey
from univoxel.ops.visibility import Hit
from univoxel.output.mesh import with_materials
from univoxel.output.surface import cameras_of, surface_of
from univoxel.output.topology import simplify
from univoxel.render.relight import Lighting, TracedMesh, relight_surface, traced_mesh
from univoxel.run import photos_of
from univoxel.scene import Scene, load_scene
from univoxel.sphere import direction_to_latlong, latlong_directions, texel_solid_angles

FACES = 100_000  # most triangles: finer ones are smaller than pixels, and cost time


@dataclass(frozen=True)
class Subject:
    """A trained scene, ready to be looked at."""

    scene: Scene
    traced: TracedMesh
    run: Path | None = None  # its folder; None: nothing is known of photographs

    @cached_property
    def bounds(self) -> tuple[Tensor, Tensor]:
        """The lower and the upper corner [3] of the mesh."""
        return self.traced.mesh.vertices.amin(0), self.traced.mesh.vertices.amax(0)

    @property
    def ground(self) -> float:
        """z of the lowest point, world units."""
        return float(self.bounds[0][2])

    @cached_property
    def photos(self) -> Photos:
        """The photographs that were trained on, where their cameras are believed to be; a UserError
        where they are not there any more."""
        if self.run is None:
            raise UserError("view: this needs the photographs of a run, so pass the run's folder")
        return self.scene.registered(photos_of(self.run, split="train"))

    @cached_property
    def albedo_error(self) -> Tensor:
        """Expected error of the albedo at the mesh's vertices: [P], sRGB."""
        found = ExpectedErrors(survey(self.scene, self.photos, POINTS))
        mesh = self.traced.mesh
        assert mesh.normals is not None
        return found.at(mesh.vertices, mesh.normals)[:, 0]


def subject_of(run: Path) -> Subject:
    """The scene of a run's folder, and its mesh; a UserError if there is none."""
    scene = load_scene(run)
    mesh = mesh_of(scene, cameras=cameras_of(scene, run))
    return Subject(scene, traced_mesh(mesh, scene.field.voxel_size), run)


def mesh_of(scene: Scene, faces: int = FACES, cameras: Cameras | None = None) -> Mesh:
    """The surface, as in `surface_of`, with at most so many triangles, materials and normals at its
    vertices."""
    return with_materials(scene, simplify(surface_of(scene, cameras), faces))


def surface_along(subject: Subject, rays: Rays) -> tuple[Surface, Tensor, Hit]:
    """What rays meet of the mesh, wo [N, 3] and the hits: no volume is marched.

    Materials and normals are those of the triangle's corners in between; features are empty.
    """
    mesh = subject.traced.mesh
    hit = subject.traced.visibility.closest_hit(rays.origin, rays.direction)
    met = hit.face >= 0
    assert mesh.normals is not None
    assert mesh.albedo is not None
    assert mesh.roughness is not None
    depth = torch.where(met, hit.t, 0.0)
    surface = Surface(
        position=rays.origin + depth[:, None] * rays.direction,
        normal=torch.nn.functional.normalize(at_hits(mesh, hit, mesh.normals), dim=1),
        features=rays.origin.new_empty(len(met), 0),
        albedo=at_hits(mesh, hit, mesh.albedo),
        roughness=at_hits(mesh, hit, mesh.roughness),
        opacity=met.float(),
        depth=depth,
        metallic=None if mesh.metallic is None else at_hits(mesh, hit, mesh.metallic),
    )
    return surface, -rays.direction, hit


def at_hits(mesh: Mesh, hit: Hit, values: Tensor) -> Tensor:
    """Values [P, ...] of vertices where rays meet the mesh: [N, ...], 0 where they meet nothing."""
    found = values.new_zeros(len(hit.face), *values.shape[1:])
    met = (hit.face >= 0).nonzero()[:, 0]
    u, v = hit.barycentric[met].unbind(1)
    corners = values[mesh.faces[hit.face[met]].long()]  # [M, 3, ...]
    weight = torch.stack([1 - u - v, u, v], 1)
    found[met] = torch.einsum("mk,mk...->m...", weight, corners)
    return found


# The light that arrives at a point of a subject's surface, as a small lat-long picture.


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
    surface, _, hit = surface_along(subject, ray)
    return None if hit.face[0] < 0 else Point(surface.position[0], surface.normal[0])


@torch.no_grad()
def incident_light(
    subject: Subject, point: Point, lighting: Lighting, rows: int = ROWS, samples: int = SAMPLES
) -> Tensor:
    """Radiance that arrives at a point from everywhere, linear: [rows, 2 rows, 3].

    Texels are directions as in environment maps. From where the mesh is in the way comes what that
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
