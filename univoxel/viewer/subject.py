"""What a viewer shows: the scene, its mesh with materials, and what photographs say of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from univoxel.assets.topology import clean, simplify
from univoxel.brdf import metal_or_none
from univoxel.camera import Cameras, image_rays
from univoxel.checkpoint import load_scene
from univoxel.confidence.doubts import Doubts
from univoxel.confidence.survey import POINTS, survey
from univoxel.data import Photos
from univoxel.errors import UserError
from univoxel.ops.visibility import Hit
from univoxel.records import Mesh, Rays, Surface
from univoxel.render.pipeline import RAYS_AT_ONCE
from univoxel.render.relight import TracedMesh, traced_mesh
from univoxel.run import photos_of
from univoxel.scene import Scene

FACES = 100_000  # most triangles: finer ones are smaller than pixels, and cost time


@dataclass(frozen=True)
class Subject:
    """A trained scene, ready to be looked at."""

    scene: Scene
    traced: TracedMesh
    run: Path | None = None  # its folder; None: nothing is known of photographs

    @cached_property
    def ground(self) -> float:
        """z of the lowest point, world units."""
        return float(self.traced.mesh.vertices[:, 2].min())

    @cached_property
    def photos(self) -> Photos:
        """The photographs that were trained on, where their cameras are believed to be.

        Raises:
            UserError: they are not there any more.
        """
        if self.run is None:
            raise UserError("view: expected the folder of a run with photographs, got none")
        return self.scene.registered(photos_of(self.run, split="train"))

    @cached_property
    def doubt(self) -> Tensor:
        """What photographs leave open of the albedo at the mesh's vertices: [P] in [0, 1].

        Raises:
            UserError: the photographs are not there any more.
        """
        found = Doubts(survey(self.scene, self.photos, POINTS))
        mesh = self.traced.mesh
        assert mesh.normals is not None
        return found.at(mesh.vertices, mesh.normals)[:, 0].clamp(0, 1)


def subject_of(run: Path) -> Subject:
    """The scene of a run's folder, and its mesh.

    Raises:
        UserError: the run cannot be used, or there is no surface.
    """
    scene = load_scene(run)
    return Subject(scene, traced_mesh(mesh_of(scene), scene.field.voxel_size), run)


@torch.no_grad()
def mesh_of(scene: Scene, faces: int = FACES) -> Mesh:
    """The surface with at most so many triangles, materials and normals at its vertices."""
    mesh = simplify(clean(Mesh(*scene.field.isosurface())), faces)
    parts = []
    for points in mesh.vertices.split(RAYS_AT_ONCE):
        sample = scene.field.sample(points)
        normal = torch.nn.functional.normalize(sample.gradient, dim=1, eps=1e-6)
        parts.append((normal, *scene.material(sample.features)))
    *rest, metallic = (torch.cat(part) for part in zip(*parts, strict=True))
    return Mesh(mesh.vertices, mesh.faces, *rest, metallic=metal_or_none(metallic))


def mesh_surface(subject: Subject, cameras: Cameras, view: int = 0) -> tuple[Surface, Tensor, Hit]:
    """What the rays of a view meet of the mesh, as of `surface_along`."""
    return surface_along(subject, image_rays(cameras, view))


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
