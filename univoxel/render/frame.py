"""One relit picture: object, floor and background put together, as layers, channels and sRGB."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import get_args

import torch
from torch import Tensor

from univoxel import envmap as env
from univoxel.brdf import metal_or_none
from univoxel.camera import Cameras, image_rays
from univoxel.color import linear_to_srgb
from univoxel.errors import UserError
from univoxel.names import BOUNCES, SAMPLES, Background
from univoxel.records import Surface
from univoxel.render.relight import (
    Lighting,
    TracedMesh,
    ground_shadow,
    relight_surface,
    relight_until,
)


@dataclass(frozen=True)
class Quality:
    """How a frame is made.

    Raises:
        UserError: a field is out of range.
    """

    samples: int = SAMPLES  # of the light, per pixel; >= 1
    noise: float | None = None  # instead: samples until `relight_until` finds less; > 0
    bounces: int = BOUNCES  # reflections between parts of the object, >= 0
    background: Background = "transparent"
    ground: float | None = None  # z of a floor that catches the shadow, world units

    def __post_init__(self) -> None:
        for name, value, ok in (
            ("samples must be at least 1", self.samples, self.samples >= 1),
            ("samples must be at most 2^31", self.samples, self.samples <= 2**31),
            ("noise must be above 0", self.noise, self.noise is None or self.noise > 0),
            ("bounces must be at least 0", self.bounces, self.bounces >= 0),
            (
                "background must be transparent, map or black",
                self.background,
                self.background in get_args(Background),
            ),
            (
                "ground must be finite",
                self.ground,
                self.ground is None or math.isfinite(self.ground),
            ),
        ):
            if not ok:
                raise UserError(f"relight: {name}, got {value!r}", name.split()[0])


@dataclass(frozen=True)
class Picture:
    """Layers of a relit view, row 0 on top; colours linear."""

    rgb: Tensor  # [H, W, 3] on the background; premultiplied where that is transparent
    albedo: Tensor  # [H, W, 3] on black
    normal: Tensor  # [H, W, 3] world, 0 where nothing is
    depth: Tensor  # [H, W] along the camera's -Z, world units, 0 where nothing is
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
    for name, value, letters in (
        ("rgb", picture.rgb, "RGB"),
        ("albedo", picture.albedo, "RGB"),
        ("normal", picture.normal, "XYZ"),
    ):
        out |= {f"{name}.{c}": value[..., k] for k, c in enumerate(letters)}
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
