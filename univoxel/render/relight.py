"""Relighting of a surface: path tracing to a noise level, shadows on a floor, compositing."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, get_args

import torch
from torch import Tensor

from univoxel import envmap as env
from univoxel.brdf import F0, metal_or_none, split
from univoxel.camera import Cameras, image_rays
from univoxel.color import linear_to_srgb, luminance
from univoxel.core.choices import BOUNCES, SAMPLES, Background
from univoxel.core.records import Mesh, Rays, Surface
from univoxel.errors import demand
from univoxel.ops import EnvTables, PointLight, Sun, VisibilityScene, relight

FIRST_PASS = 4  # samples of either half of the first pass towards a noise limit
MOST_SAMPLES = 4096  # per pixel, where a noise limit is out of reach
SCOUTS = 64  # samples that look whether a place on the floor is shaded at all
INTERVAL = 1.96  # standard deviations that hold 95 % of a normal distribution


@dataclass(frozen=True)
class TracedMesh:
    """A mesh and its ray hierarchy; `traced_mesh` makes it, once for any number of pictures."""

    mesh: Mesh  # with materials at its vertices
    visibility: VisibilityScene  # of the same mesh
    offset: float  # from a surface, where rays start; world units


@dataclass(frozen=True)
class Lighting:
    """What lights a picture; `univoxel.envmap.tables` makes the tables, once for a map."""

    tables: EnvTables
    suns: tuple[Sun, ...] = ()
    point_lights: tuple[PointLight, ...] = ()


def traced_mesh(mesh: Mesh, offset: float) -> TracedMesh:
    """A mesh with its ray hierarchy, which takes some 0.3 s per million triangles to build."""
    return TracedMesh(mesh, VisibilityScene(mesh.vertices, mesh.faces), offset)


def rotated(lighting: Lighting, degrees: float) -> Lighting:
    """The light with map and suns turned counter-clockwise about +Z; point lights stay."""
    angle = math.radians(degrees)
    c, s = math.cos(angle), math.sin(angle)
    suns = tuple(
        replace(sun, direction=(c * x - s * y, s * x + c * y, z))
        for sun in lighting.suns
        for x, y, z in [sun.direction]
    )
    tables = replace(lighting.tables, rotation=lighting.tables.rotation + angle)
    return Lighting(tables, suns, lighting.point_lights)


@torch.no_grad()
def relight_surface(
    surface: Surface,
    wo: Tensor,  # [N, 3]
    traced: TracedMesh,
    lighting: Lighting,
    *,
    samples: int,
    bounces: int,
    first: int = 0,
    seed: int = 0,
) -> Tensor:
    """Radiance [N, 3] that a surface sends along wo, linear; black where its opacity is 0.

    The traced mesh casts shadows and sends light on. Arguments, errors and sources as of
    `univoxel.ops.relight`.
    """
    hit = surface.opacity > 0
    rgb = surface.position.new_zeros(len(hit), 3)
    metallic = None if surface.metallic is None else surface.metallic[hit]
    diffuse, f0 = split(surface.albedo[hit], metallic)
    places = surface.position[hit], surface.normal[hit], wo[hit], diffuse, surface.roughness[hit]
    how = {"samples": samples, "bounces": bounces, "first": first, "seed": seed}
    rgb[hit] = _relit(traced, lighting, *places, f0=f0, **how)
    return rgb


def _relit(traced: TracedMesh, lighting: Lighting, *places: Tensor, **how: Any) -> Tensor:
    """`univoxel.ops.relight` of places under all light, which the mesh blocks and sends on."""
    mesh, mesh_f0 = traced.mesh, F0
    if mesh.albedo is not None:
        diffuse, mesh_f0 = split(mesh.albedo, mesh.metallic)
        mesh = replace(mesh, albedo=diffuse)
    more = {"suns": lighting.suns, "point_lights": lighting.point_lights, "mesh_f0": mesh_f0}
    how = {"offset": traced.offset, **more, **how}
    return relight(traced.visibility, mesh, lighting.tables, *places, **how)


@torch.no_grad()
def relight_until(
    surface: Surface,
    wo: Tensor,  # [N, 3]
    traced: TracedMesh,
    lighting: Lighting,
    *,
    noise: float,
    bounces: int,
    seed: int = 0,
    report: Callable[[float], None] = lambda share: None,
) -> tuple[Tensor, float, int]:
    """`relight_surface` with as many samples as it takes; (rgb [N, 3], its noise, samples a pixel).

    Two halves A and B with scrambles of their own grow side by side, doubling with every pass.
    Their mean is the picture; the noise of it, relative to the picture, is

        1.96 sqrt(mean over pixels of ((Y_A - Y_B) / 2)^2) / mean over pixels of (Y_A + Y_B) / 2

    with Y the luminance times the opacity, over pixels with a surface: half the width of the 95 %
    interval of a pixel's mean, in the root mean square, against the mean luminance. As (Y_A -
    Y_B)^2 / 4 is an unbiased estimate of the variance of their mean, what the sequence gains over
    independent samples counts in.

    Args:
        noise: passes end when the estimate is at most this, > 0, such as 0.02; or when
            MOST_SAMPLES are reached.
        report: called after each pass with the share of the work that is done, as estimated.
    """
    demand(noise > 0, "noise", "above 0", noise)
    weight = surface.opacity[surface.opacity > 0]
    halves = [torch.zeros_like(surface.position) for _ in range(2)]
    done, more = 0, FIRST_PASS
    while True:
        for k, half in enumerate(halves):
            # Seeds apart by an odd constant: those of other pictures count up from theirs.
            own = (seed + k * 0x9E3779B9) % 2**32
            rgb = relight_surface(
                surface, wo, traced, lighting, samples=more, bounces=bounces, first=done, seed=own
            )
            half.mul_(done / (done + more)).add_(rgb, alpha=more / (done + more))
        done += more
        a, b = (luminance(half[surface.opacity > 0]) * weight for half in halves)
        light = (a + b).sum() / 2
        deviation = ((a - b) / 2).square().sum().mul(len(a)).sqrt()
        error = float(INTERVAL * deviation / light) if light > 0 else 0.0
        if error <= noise or 2 * done >= MOST_SAMPLES:
            return (halves[0] + halves[1]) / 2, error, 2 * done
        report((noise / error) ** 2)
        more = done


@torch.no_grad()
def ground_shadow(
    rays: Rays,
    height: float,
    traced: TracedMesh,
    lighting: Lighting,
    *,
    samples: int,
    bounces: int,
    hidden: Tensor | None = None,  # [N]
    seed: int = 0,
) -> Tensor:
    """How much darker the object makes a matte white floor that rays meet: [N] in [0, 1].

        1 - Y(floor with the object) / Y(floor without it)

    with Y the luminance that the floor sends straight up; 0 where a ray misses it. Both are
    rendered with the same samples, so that noise is where shadow is. Light that the object sends
    to the floor counts in, but never above what its shadow takes.

    Args:
        height: z of the floor, world units. Rays from below do not meet it.
        samples: of the light, per ray; SCOUTS where none of these meets the object.
        hidden: [N] bool, rays that need no answer; they get 0.
    """
    meets = (rays.direction[:, 2] < 0) & (rays.origin[:, 2] > height)
    if hidden is not None:
        meets &= ~hidden
    where = meets.nonzero()[:, 0]
    origin, direction = rays.origin[where], rays.direction[where]
    points = origin + (height - origin[:, 2:]) / direction[:, 2:] * direction
    points[:, 2] = height
    floor = partial(_floor, traced=traced, lighting=lighting, bounces=bounces, seed=seed)
    shadow = rays.origin.new_zeros(len(meets))
    few = min(samples, SCOUTS)
    alone, lit = floor(points, first=0, samples=few)
    # Most of a floor lies in full light: only where a ray met the object are hit more to trace.
    if samples > few:
        touched = (alone != lit).nonzero()[:, 0]
        rest = floor(points[touched], first=few, samples=samples - few)
        for total, more in zip((alone, lit), rest, strict=True):
            total[touched] += (more - total[touched]) * (1 - few / samples)
    shadow[where] = torch.where(alone > 0, 1 - lit / alone.clamp_min(1e-30), 0.0).clamp(0, 1)
    return shadow


def _floor(
    points: Tensor,
    *,
    traced: TracedMesh,
    lighting: Lighting,
    bounces: int,
    first: int,
    samples: int,
    seed: int,
) -> tuple[Tensor, Tensor]:
    """Luminance [N] that points of a white floor send up, without the object and with it."""
    up = torch.tensor([0.0, 0.0, 1.0]).expand_as(points)
    nothing = VisibilityScene(torch.empty(0, 3), torch.empty(0, 3, dtype=torch.int32))
    floor = points, up, up, torch.ones_like(points), torch.ones(len(points))
    how = {"f0": 0.0, "offset": 0.0, "first": first, "samples": samples, "seed": seed}
    alone, lit = (
        _relit(replace(traced, visibility=v), lighting, *floor, bounces=reflections, **how)
        for v, reflections in ((nothing, 0), (traced.visibility, bounces))
    )
    return luminance(alone), luminance(lit)


# One relit picture: object, floor and background put together, as layers, channels and sRGB.


@dataclass(frozen=True)
class Quality:
    """How a frame is made; a UserError for a field out of range."""

    samples: int = SAMPLES  # of the light, per pixel; >= 1
    noise: float | None = None  # instead: samples until `relight_until` finds less; > 0
    bounces: int = BOUNCES  # reflections between parts of the object, >= 0
    background: Background = "transparent"
    ground: float | None = None  # z of a floor that catches the shadow, world units

    def __post_init__(self) -> None:
        noise, ground, behind = self.noise, self.ground, self.background
        demand(self.samples >= 1, "samples", "at least 1", self.samples)
        demand(self.samples <= 2**31, "samples", "at most 2^31", self.samples)
        demand(noise is None or noise > 0, "noise", "above 0", noise)
        demand(self.bounces >= 0, "bounces", "at least 0", self.bounces)
        known = "transparent, map or black"
        demand(behind in get_args(Background), "background", known, repr(behind))
        demand(ground is None or math.isfinite(ground), "ground", "finite", ground)


@dataclass(frozen=True)
class Picture:
    """Layers of a relit view, row 0 on top; colours linear."""

    rgb: Tensor  # [H, W, 3] on the background; premultiplied where that is transparent
    albedo: Tensor  # [H, W, 3] on black
    normal: Tensor  # [H, W, 3] world, 0 where there is nothing
    depth: Tensor  # [H, W] along the camera's -Z, world units, 0 where there is nothing
    alpha: Tensor  # [H, W] of the object
    shadow: Tensor | None  # [H, W] what the floor loses of its light, where there is a floor
    metallic: Tensor | None  # [H, W] on black, where the scene has metal
    opaque: bool  # whether something stands behind


@torch.no_grad()
def render_picture(
    surface: Surface,
    wo: Tensor,  # [H * W, 3]
    cameras: Cameras,
    view: int,
    traced: TracedMesh,
    lighting: Lighting,
    quality: Quality,
    seed: int = 0,
    report: Callable[[float], None] = lambda share: None,
) -> Picture:
    """Light a view's surface, as `univoxel.render.pipeline.surface_of_view` gives it.

    Args:
        report: called with the share of the work that is done, where there is a noise limit.
    """
    options = {"bounces": quality.bounces, "seed": seed}
    samples = quality.samples
    if quality.noise is None:
        rgb = relight_surface(surface, wo, traced, lighting, samples=samples, **options)
    else:
        rgb, _, samples = relight_until(
            surface, wo, traced, lighting, noise=quality.noise, report=report, **options
        )
    alpha = surface.opacity[:, None]
    hit = alpha > 0
    rgb, clear = rgb * alpha, 1 - alpha
    rays, shadow = image_rays(cameras, view), None
    if quality.ground is not None:
        shadow = ground_shadow(
            rays,
            quality.ground,
            traced,
            lighting,
            samples=samples,
            hidden=surface.opacity > 0.999,
            **options,
        )
        clear = clear * (1 - shadow[:, None])
    if quality.background == "map":
        rgb = rgb + clear * env.background(lighting.tables, rays.direction)
    metallic = None if surface.metallic is None else metal_or_none(surface.metallic)
    backward = cameras.camera_to_world[view, :, 2]
    width, height = cameras.size(view)

    def grid(values: Tensor) -> Tensor:
        return values.reshape(height, width, *values.shape[1:])

    return Picture(
        rgb=grid(rgb),
        albedo=grid(surface.albedo * alpha),
        normal=grid(torch.where(hit, surface.normal, 0.0)),
        depth=grid(torch.where(hit[:, 0], surface.depth * (wo @ backward), 0.0)),
        alpha=grid(surface.opacity),
        shadow=None if shadow is None else grid(shadow),
        metallic=None if metallic is None else grid(metallic * surface.opacity),
        opaque=quality.background != "transparent",
    )


def channels(picture: Picture) -> dict[str, Tensor]:
    """The channels of a saved EXR file, [H, W] each: rgb.R, normal.X, depth and so on."""
    out = {"depth": picture.depth, "alpha": picture.alpha}
    for name in ("shadow", "metallic"):
        if (layer := getattr(picture, name)) is not None:
            out[name] = layer
    for name, letters in (("rgb", "RGB"), ("albedo", "RGB"), ("normal", "XYZ")):
        layer = getattr(picture, name)
        out |= {f"{name}.{c}": layer[..., k] for k, c in enumerate(letters)}
    return out


def rgba(picture: Picture) -> Tensor:
    """[H, W, 4] linear, premultiplied; alpha holds the floor's shadow, and is 1 on a background."""
    if picture.opaque:
        alpha = torch.ones_like(picture.alpha)
    elif picture.shadow is None:
        alpha = picture.alpha
    else:
        alpha = 1 - (1 - picture.alpha) * (1 - picture.shadow)
    return torch.cat([picture.rgb, alpha.clamp(0, 1)[..., None]], -1)


def srgb(picture: Picture) -> Tensor:
    """[H, W, 3 or 4] as a PNG holds it: sRGB, with straight alpha unless a background is there."""
    values = rgba(picture)
    rgb, alpha = values[..., :3], values[..., 3:]
    if picture.opaque:
        return linear_to_srgb(rgb)
    return torch.cat([linear_to_srgb(rgb / alpha.clamp_min(1e-6)), alpha], -1)
