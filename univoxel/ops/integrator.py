"""Light that points of a surface send to the eye under an environment map, by path tracing."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from univoxel.ops import native
from univoxel.ops.checks import check
from univoxel.ops.visibility import VisibilityScene
from univoxel.records import Mesh

Strategy = Literal["mis", "map", "brdf"]


@dataclass(frozen=True)
class EnvTables:
    """An environment map as the integrator reads it; `univoxel.envmap.tables` makes them."""

    radiance: Tensor  # [H, W, 3] float32 linear, >= 0
    row_cdf: Tensor  # [H + 1] float32 from 0 to 1: which row a sample falls in
    column_cdf: Tensor  # [H, W + 1] float32 from 0 to 1: which column, given the row
    rotation: float  # radians, counter-clockwise about +Z


def relight(
    scene: VisibilityScene,
    mesh: Mesh,
    tables: EnvTables,
    position: Tensor,  # [N, 3]
    normal: Tensor,  # [N, 3]
    wo: Tensor,  # [N, 3]
    albedo: Tensor,  # [N, 3]
    roughness: Tensor,  # [N]
    *,
    offset: float,
    samples: int,
    bounces: int = 0,
    seed: int = 0,
    strategy: Strategy = "mis",
) -> Tensor:
    """Radiance that surface points send along wo under an environment map.

        L(wo) = integral over the half-sphere of f(wi, wo) L_i(wi) (n.wi) dwi

    L_i is the map where nothing stands in the way, else what the mesh sends back, up to `bounces`
    times. Each sample draws one direction from the map and one from the BRDF at every vertex of
    its path and weighs both by the power heuristic; points come from Sobol's sequence with a
    scramble of its own per point. Paths end at random where they carry little.

    Points given come from volume rendering and lie on the mesh only about: their rays start at
    position + offset * normal and pass through whatever is nearer than `offset` from there. Later
    vertices lie on the mesh; both of its sides reflect. Directions below the horizon of the shading
    normal carry nothing; an eye behind it sees the surface at grazing angle.

    Args:
        scene: the triangles of `mesh`.
        mesh: with normals, albedo and roughness at its vertices where bounces > 0.
        tables: the light, from `univoxel.envmap.tables`.
        position: [N, 3] float32, world.
        normal: [N, 3] float32 unit.
        wo: [N, 3] float32 unit, to the eye.
        albedo: [N, 3] float32 linear, in [0, 1].
        roughness: [N] float32 perceptual, in [0, 1].
        offset: world units, about one voxel, >= 0.
        samples: paths per point, >= 1; powers of 2 are best.
        bounces: reflections after the first point, >= 0; 0 is direct light only.
        seed: another seed, other noise; in 0 .. 2^32 - 1.
        strategy: "map" or "brdf" draws from one of the two alone: the same mean, more noise.

    Returns:
        [N, 3] float32 linear, finite: a point with no normal, or with anything that is not finite,
        comes out black. The same bits for any number of threads.

    Raises:
        TypeError, ValueError: an argument is no tensor, or of another size, dtype or device, or out
            of the range above; materials are missing; the scene is of another mesh.
        RuntimeError: the compiled extension is missing; there is no reference to fall back to.

    Carries no gradients.
    Source: Veach 1997, chapters 9 and 10; Heitz 2018 and Dupuy and Benyoub 2023 (visible normals);
    Burley 2020 (Owen scrambling).
    """
    check(
        "relight",
        position=(position, "N 3", torch.float32),
        normal=(normal, "N 3", torch.float32),
        wo=(wo, "N 3", torch.float32),
        albedo=(albedo, "N 3", torch.float32),
        roughness=(roughness, "N", torch.float32),
        radiance=(tables.radiance, "H W 3", torch.float32),
        row_cdf=(tables.row_cdf, "H+1", torch.float32),
        column_cdf=(tables.column_cdf, "H W+1", torch.float32),
    )
    if position.device.type != "cpu":
        raise ValueError(f"relight: points must be on the cpu, got {position.device}")
    for name, value, ok in (
        ("offset must be finite and at least 0", offset, 0 <= offset < math.inf),
        ("samples must be at least 1", samples, samples >= 1),
        ("bounces must be at least 0", bounces, bounces >= 0),
        ("seed must be in 0 .. 2^32 - 1", seed, 0 <= seed < 2**32),
        ("strategy must be mis, map or brdf", strategy, strategy in ("mis", "map", "brdf")),
    ):
        if not ok:
            raise ValueError(f"relight: {name}, got {value!r}")
    materials = _materials(scene, mesh) if bounces else (None, None, None)
    traced = scene.native()
    if traced is None:
        raise RuntimeError("relight: runs on the native backend only, got use_backend('reference')")
    rgb = torch.empty_like(position, memory_format=torch.contiguous_format)
    light = (tables.radiance, tables.row_cdf, tables.column_cdf)
    points = (position, normal, wo, albedo, roughness)
    core = native.require()
    core.relight(
        traced,
        *(m if m is None else native.arrays(m.contiguous())[0] for m in materials),
        *native.arrays(*(t.contiguous() for t in light)),
        tables.rotation,
        *native.arrays(*(t.contiguous() for t in points), rgb),
        offset,
        samples,
        bounces,
        seed,
        getattr(core.Strategy, strategy),
        native.threads(),
    )
    return rgb


def _materials(scene: VisibilityScene, mesh: Mesh) -> tuple[Tensor, Tensor, Tensor]:
    """Normals, albedo and roughness at the vertices of the scene's mesh."""
    if mesh.normals is None or mesh.albedo is None or mesh.roughness is None:
        raise ValueError("relight: bounces need a mesh with normals, albedo and roughness")
    check(
        "relight",
        mesh_vertices=(scene.vertices, "P 3", torch.float32),
        mesh_normals=(mesh.normals, "P 3", torch.float32),
        mesh_albedo=(mesh.albedo, "P 3", torch.float32),
        mesh_roughness=(mesh.roughness, "P", torch.float32),
    )
    return mesh.normals, mesh.albedo, mesh.roughness
