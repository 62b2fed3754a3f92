"""Radiance that surface points send to the eye under an environment map, by path tracing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from univoxel.brdf import F0
from univoxel.core.records import Mesh
from univoxel.ops import native
from univoxel.ops.differentiable import check
from univoxel.ops.shade import stored_f0
from univoxel.ops.visibility import VisibilityScene

Strategy = Literal["mis", "map", "brdf"]


@dataclass(frozen=True)
class EnvTables:
    """An environment map as the integrator reads it, created by `univoxel.envmap.tables`."""

    texel: Tensor  # [H, W, 4] float32: linear radiance, >= 0; sampling density, 1 / steradian
    row_cdf: Tensor  # [H + 1] float32 from 0 to 1: which row a sample falls in
    column_cdf: Tensor  # [H, W + 1] float32 from 0 to 1: which column, given the row
    rotation: float  # radians, counter-clockwise about +Z

    @property
    def radiance(self) -> Tensor:
        """[H, W, 3]"""
        return self.texel[..., :3]


Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Sun:
    """A distant disc of uniform light.

    Raises:
        ValueError: a number is not finite, the direction has no length, the irradiance is below 0,
            or the angle is not in [0, 180).
    """

    direction: Triple  # to it, world; any length above 0
    irradiance: Triple  # linear, on a surface that faces it
    angle: float = 0.53  # degrees across; 0 casts hard shadows

    def __post_init__(self) -> None:
        if not 0 < math.hypot(*self.direction) < math.inf:
            raise ValueError(f"sun: direction must not be zero or infinite, got {self.direction}")
        _check_power("sun: irradiance", self.irradiance)
        if not 0 <= self.angle < 180:
            raise ValueError(f"sun: angle must be in [0, 180) degrees, got {self.angle}")


@dataclass(frozen=True)
class PointLight:
    """A point that emits uniformly; irradiance falls with the squared distance.

    Raises:
        ValueError: a number is not finite, or the intensity is below 0.
    """

    position: Triple  # world
    intensity: Triple  # radiant intensity, linear: irradiance at distance 1

    def __post_init__(self) -> None:
        if not math.isfinite(sum(self.position)):
            raise ValueError(f"point light: position must be finite, got {self.position}")
        _check_power("point light: intensity", self.intensity)


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
    suns: Sequence[Sun] = (),
    point_lights: Sequence[PointLight] = (),
    f0: Tensor | float = F0,
    mesh_f0: Tensor | float = F0,
    first: int = 0,
    seed: int = 0,
    strategy: Strategy = "mis",
) -> Tensor:
    """Path-traced radiance of surface points along wo, under an environment map and other lights.

        L(wo) = integral over the half-sphere of f(wi, wo) L_i(wi) (n.wi) dwi

    L_i is the light if nothing blocks it, and else the radiance of the mesh, for up to `bounces`
    reflections. Every vertex of a path sends a shadow ray to each sun and point light. It samples
    one direction of the map in proportion to its light and one of the BRDF, weighted by the power
    heuristic. The samples are Sobol's sequence, with an Owen scramble per surface point. Paths with
    little throughput end at random.

    The given points come from volume rendering and lie only roughly on the mesh: their rays start
    at position + offset * normal and pass through triangles that are nearer than `offset` from
    there. Later vertices lie on the mesh, both of whose sides reflect. Directions below the horizon
    of the shading normal contribute nothing; an eye behind it sees the surface at grazing angle.

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
        suns, point_lights: lights besides the map.
        f0: [N, 3] float32 or a number, in [0, 1]: reflectance at normal incidence. A metal has its
            colour here and albedo 0.
        mesh_f0: [P, 3] likewise at the mesh's vertices, for bounces.
        first: number of the first sample in the sequence, >= 0: the mean of samples 0 .. 63 is the
            mean of those of 0 .. 31 and 32 .. 63.
        seed: in 0 .. 2^32 - 1; each seed gives other noise.
        strategy: "map" or "brdf" samples only one of the two: the same mean, with more noise.

    Returns:
        [N, 3] float32 linear, finite: a point is black if it has no normal or any value that is not
        finite. Bit-identical for any number of threads.

    Raises:
        TypeError, ValueError: an argument is no tensor, or of another size, dtype or device, or out
            of the range above; materials are missing; the scene is of another mesh.
        RuntimeError: the compiled extension is missing; there is no reference to fall back to.

    Carries no gradients. Source: Veach 1997, chapters 9 and 10; Heitz 2018 and Dupuy and Benyoub
    2023 (visible normals); Burley 2020 (Owen scrambling).
    """
    check(
        "relight",
        position=(position, "N 3", torch.float32),
        normal=(normal, "N 3", torch.float32),
        wo=(wo, "N 3", torch.float32),
        albedo=(albedo, "N 3", torch.float32),
        roughness=(roughness, "N", torch.float32),
        texel=(tables.texel, "H W 4", torch.float32),
        row_cdf=(tables.row_cdf, "H+1", torch.float32),
        column_cdf=(tables.column_cdf, "H W+1", torch.float32),
    )
    if position.device.type != "cpu":
        raise ValueError(f"relight: points must be on the cpu, got {position.device}")
    if isinstance(f0, Tensor):
        check("relight", position=(position, "N 3", torch.float32), f0=(f0, "N 3", torch.float32))
    for name, value, ok in (
        ("offset must be finite and at least 0", offset, 0 <= offset < math.inf),
        ("samples must be at least 1", samples, samples >= 1),
        ("bounces must be at least 0", bounces, bounces >= 0),
        ("first must be at least 0", first, first >= 0),
        ("first + samples must be at most 2^31", first + samples, first + samples <= 2**31),
        ("seed must be in 0 .. 2^32 - 1", seed, 0 <= seed < 2**32),
        ("strategy must be mis, map or brdf", strategy, strategy in ("mis", "map", "brdf")),
    ):
        if not ok:
            raise ValueError(f"relight: {name}, got {value!r}")
    materials = _materials(scene, mesh, mesh_f0) if bounces else (None,) * 4
    traced = scene.native()
    if traced is None:
        raise RuntimeError("relight: runs on the native backend only, got use_backend('reference')")
    points = (position, normal, wo, albedo, roughness, _rows_of_f0(f0, position))
    rgb = torch.empty_like(position, memory_format=torch.contiguous_format)
    native.call(
        "relight",
        traced,
        *map(_contiguous, (*materials, tables.texel, tables.row_cdf, tables.column_cdf)),
        tables.rotation,
        *map(_contiguous, (_pack_suns(suns), _pack_point_lights(point_lights), *points)),
        rgb,
        *(offset, first, samples, bounces, seed),
        getattr(native.require().Strategy, strategy),
    )
    return rgb


def _materials(scene: VisibilityScene, mesh: Mesh, f0: Tensor | float) -> tuple[Tensor, ...]:
    """Normals, albedo, roughness and F0 at the vertices of the scene's mesh."""
    if mesh.normals is None or mesh.albedo is None or mesh.roughness is None:
        raise ValueError("relight: bounces need a mesh with normals, albedo and roughness")
    check(
        "relight",
        mesh_vertices=(scene.vertices, "P 3", torch.float32),
        mesh_normals=(mesh.normals, "P 3", torch.float32),
        mesh_albedo=(mesh.albedo, "P 3", torch.float32),
        mesh_roughness=(mesh.roughness, "P", torch.float32),
        **({"mesh_f0": (f0, "P 3", torch.float32)} if isinstance(f0, Tensor) else {}),
    )
    return mesh.normals, mesh.albedo, mesh.roughness, _rows_of_f0(f0, mesh.normals)


def _rows_of_f0(f0: Tensor | float, like: Tensor) -> Tensor:
    """F0 as [N, 3], as like is."""
    return stored_f0("relight", f0, like).expand_as(like)


def _contiguous(tensor: Tensor | None) -> Tensor | None:
    return None if tensor is None else tensor.contiguous()


def _pack_suns(suns: Sequence[Sun]) -> Tensor:
    """[S, 7] as the kernel reads them: unit direction, irradiance, cosine of the radius."""
    rows = [
        [
            *(x / math.hypot(*s.direction) for x in s.direction),
            *s.irradiance,
            math.cos(math.radians(s.angle / 2)),
        ]
        for s in suns
    ]
    return torch.tensor(rows, dtype=torch.float32).reshape(-1, 7)


def _pack_point_lights(point_lights: Sequence[PointLight]) -> Tensor:
    """[L, 6]: position, intensity."""
    rows = [[*light.position, *light.intensity] for light in point_lights]
    return torch.tensor(rows, dtype=torch.float32).reshape(-1, 6)


def _check_power(name: str, power: Triple) -> None:
    if not all(0 <= x < math.inf for x in power):
        raise ValueError(f"{name} must be finite and at least 0, got {power}")
