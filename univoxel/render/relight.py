"""A surface under a new environment map."""

from __future__ import annotations

import torch
from torch import Tensor

from univoxel import envmap as env
from univoxel.ops import VisibilityScene, relight
from univoxel.records import Mesh, Surface


@torch.no_grad()
def relight_surface(
    surface: Surface,
    wo: Tensor,  # [N, 3]
    mesh: Mesh,
    envmap: env.EnvMap,
    *,
    samples: int,
    bounces: int,
    offset: float,
    seed: int = 0,
) -> Tensor:
    """Radiance [N, 3] that a surface sends along wo under a map, linear; black where opacity is 0.

    The mesh casts shadows and sends light on; it is built into a hierarchy once a call, some 0.3 s
    per million triangles. Arguments, errors and sources as of `univoxel.ops.relight`.
    """
    there = surface.opacity > 0
    rgb = surface.position.new_zeros(len(there), 3)
    rgb[there] = relight(
        VisibilityScene(mesh.vertices, mesh.faces),
        mesh,
        env.tables(envmap),
        surface.position[there],
        surface.normal[there],
        wo[there],
        surface.albedo[there],
        surface.roughness[there],
        offset=offset,
        samples=samples,
        bounces=bounces,
        seed=seed,
    )
    return rgb
