"""Shared by tests of the path tracer: a small mesh, points on a sphere, one call to shade them."""

import math

import torch
from op_cases import unit

from univoxel.core.records import Mesh
from univoxel.envmap import EnvMap, tables
from univoxel.ops import VisibilityScene, relight

WHITE = EnvMap(torch.ones(8, 16, 3))
DARK = EnvMap(torch.zeros(1, 2, 3))


def octahedron(albedo=1.0, roughness=0.5, inside_out=False):
    """A closed mesh of eight flat faces with corners of their own; (mesh, scene)."""
    axes = torch.eye(3)
    signs = torch.tensor([[x, y, z] for x in (-1.0, 1) for y in (-1.0, 1) for z in (-1.0, 1)])
    corners = signs[:, :, None] * axes  # [8, 3, 3]
    flip = signs.prod(1) < 0
    corners = torch.where(flip[:, None, None], corners.flip(1), corners)
    vertices = corners.reshape(-1, 3)
    normals = (signs / math.sqrt(3)).repeat_interleave(3, 0)
    faces = torch.arange(24, dtype=torch.int32).reshape(8, 3)
    if inside_out:
        normals = -normals
    mesh = Mesh(vertices, faces, normals, torch.full((24, 3), albedo), torch.full((24,), roughness))
    return mesh, VisibilityScene(vertices, faces)


def sphere_points(n, seed=0, facing=0.2):
    """Points of the unit sphere, which are their own normals, and eyes that look at them."""
    normal, wo = unit(n, seed=seed), unit(n, seed=seed + 1)
    return normal, torch.nn.functional.normalize(wo + (1 + facing) * normal, dim=1)


def shade(mesh, scene, envmap, normal, wo, albedo=1.0, roughness=0.5, **kwargs):
    n = len(normal)
    arguments = {"position": normal, "offset": 0.01, "samples": 64}
    return relight(
        scene,
        mesh,
        tables(envmap),
        normal=normal,
        wo=wo,
        albedo=torch.as_tensor(albedo).expand(n, 3),
        roughness=torch.as_tensor(roughness).expand(n),
        **(arguments | kwargs),
    )
