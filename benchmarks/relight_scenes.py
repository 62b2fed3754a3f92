"""Scenes of relight.py: the arguments of `univoxel.ops.relight`, and the same for Mitsuba."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from univoxel import brdf
from univoxel.camera import image_rays, resize
from univoxel.core.records import Mesh, Rays
from univoxel.data import load_photos
from univoxel.data.images import read_image
from univoxel.envmap import EnvMap, lookup, tables
from univoxel.ops import VisibilityScene

TESTS = Path(__file__).parent.parent / "tests"
ALBEDO, ROUGHNESS = torch.tensor([[0.6, 0.4, 0.3]]), torch.tensor([0.4])  # of the data's mesh


@dataclass(frozen=True)
class Scene:
    ours: tuple  # positional arguments of `relight`
    theirs: dict  # what tests/mitsuba_reference.py reads, without bounces and samples


def sphere_scene(size: int) -> Scene:
    """Points that a camera sees of the sphere over a plane of the tests, and its light."""
    sys.path[:0] = [str(TESTS), str(TESTS / "ops")]
    import test_integrator_mitsuba as shared

    y, x = torch.meshgrid(*[torch.linspace(-0.45, 0.45, size)] * 2, indexing="ij")
    direction = torch.nn.functional.normalize(
        torch.stack([x, torch.ones_like(x), -0.25 - y], -1).reshape(-1, 3), dim=1
    )
    rays = Rays(torch.tensor([0.0, -5.0, 0.9]).expand_as(direction).contiguous(), direction)
    light = EnvMap(shared.sky_map(256, math.pi / 2 - math.pi * (torch.arange(256) + 0.5) / 256))
    poles = shared.sky_map(256, math.pi / 2 - math.pi * torch.arange(256) / 255)
    return _scene(*shared.sphere_on_plane(), shared.ALBEDO, shared.ROUGHNESS, rays, light, poles)


def mesh_scene(folder: Path, size: int) -> Scene:
    """The first test view of a data set's true mesh, of one material, under its first other map."""
    vertices, faces, normals = true_mesh(folder)
    cameras = resize(load_photos(folder, "test").cameras, size)
    path = min(p for p in (folder / "envmaps").glob("*.hdr") if p.stem != "train")
    light = EnvMap(read_image(path))
    # Mitsuba's first and last rows lie on the poles: taken from ours at four times its size.
    height = 4 * len(light.radiance)
    theta = math.pi / 2 - math.pi * torch.arange(height) / (height - 1)
    phi = math.pi - math.pi * (torch.arange(2 * height) + 0.5) / height
    theta, phi = torch.meshgrid(theta, phi, indexing="ij")
    directions = [theta.cos() * phi.cos(), theta.cos() * phi.sin(), theta.sin()]
    poles = lookup(light, torch.stack(directions, -1).float())
    part = torch.zeros(len(vertices), dtype=torch.long)
    rays = image_rays(cameras, 0)
    return _scene(vertices, faces, normals, part, ALBEDO, ROUGHNESS, rays, light, poles)


def true_mesh(folder: Path) -> tuple[Tensor, Tensor, Tensor]:
    """Vertices [P, 3], faces [F, 3] and vertex normals [P, 3] of a data set's surface."""
    import trimesh

    loaded = trimesh.load(folder / "mesh.ply", process=False)
    return (
        torch.tensor(np.asarray(loaded.vertices), dtype=torch.float32),
        torch.tensor(np.asarray(loaded.faces), dtype=torch.int32),
        torch.tensor(np.asarray(loaded.vertex_normals).copy(), dtype=torch.float32),
    )


def _scene(
    vertices: Tensor,
    faces: Tensor,
    normals: Tensor,
    part: Tensor,  # [P] which material
    albedo: Tensor,  # [K, 3]
    roughness: Tensor,  # [K]
    rays: Rays,
    light: EnvMap,
    poles: Tensor,  # [H, W, 3] the same light, its first and last rows at the poles
) -> Scene:
    scene = VisibilityScene(vertices, faces)
    hit = scene.closest_hit(rays.origin, rays.direction)
    met = hit.face >= 0
    corner = faces.long()[hit.face[met]]
    u, v = hit.barycentric[met].unbind(1)
    weight = torch.stack([1 - u - v, u, v], 1)[..., None]
    kind = part[corner[:, 0]]
    cosine = torch.linspace(0, 1, 1025)
    return Scene(
        ours=(
            scene,
            Mesh(vertices, faces, normals, albedo[part], roughness[part]),
            tables(light),
            rays.origin[met] + hit.t[met, None] * rays.direction[met],
            torch.nn.functional.normalize((weight * normals[corner]).sum(1), dim=1),
            -rays.direction[met],
            albedo[kind],
            roughness[kind],
        ),
        theirs={
            "vertices": vertices,
            "faces": faces,
            "normals": normals,
            "part": part,
            "albedo": albedo,
            "roughness": roughness,
            "layer": torch.stack([brdf.specular_albedo(cosine, r.expand(1025)) for r in roughness]),
            "radiance": poles,
            "origin": rays.origin[met],
            "direction": rays.direction[met],
        },
    )
