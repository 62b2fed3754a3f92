"""Frames of the viewer: fast during motion, refined and denoised at rest."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import chain, repeat
from typing import Literal, TypeAlias, get_args

import numpy as np
import torch
from torch import Tensor

from univoxel import envmap as env
from univoxel.brdf import metal_or_none
from univoxel.camera import Cameras, image_rays
from univoxel.color import linear_to_srgb
from univoxel.core.choices import BOUNCES
from univoxel.core.records import Rays, Surface
from univoxel.evaluation.confidence import ALBEDO_LIMIT
from univoxel.render.pictures import heat
from univoxel.render.pipeline import at_rays, joined, surface_at
from univoxel.render.relight import Lighting, ground_shadow, relight_surface
from univoxel.viewer.viewer_scene import Subject, at_hits, surface_along

# It takes about a second of all cores, without holding Python's lock: a view that moves meanwhile
# is answered as ever.
_BESIDE = ThreadPoolExecutor(1, "univoxel denoiser")


def available() -> bool:
    """Whether the extra `denoise` is installed."""
    return find_spec("pyoidn") is not None


Layer: TypeAlias = Literal[
    "render", "albedo", "roughness", "metal", "normal", "depth", "expected error"
]
LAYERS: tuple[Layer, ...] = get_args(Layer)

QUICK_SAMPLES = 2  # of the light a pixel, while something moves
QUICK_BOUNCES = 1
FLOOR_SAMPLES = 4  # of the light for the floor's shadow, while something moves
PASSES = (4, 4, 8, 16, 32)  # samples of the passes at rest; the last one again and again
MOST_SAMPLES = 1024  # per pixel at rest: no eye sees the noise that is left
WAIT_SECONDS = 0.05  # for the denoiser, in one step
STEP_RAYS = 4096  # that are marched in one step, some 0.05 s
STEP_PATHS = 2**15  # that are traced in one step, likewise


@dataclass(frozen=True)
class Look:
    """How a subject is shown."""

    lighting: Lighting
    layer: Layer = "render"
    exposure: float = 0.0  # stops
    ground: bool = False  # whether a floor under the object catches its shadow
    backdrop: bool = False  # whether the map stands behind
    denoise: bool = False  # at rest; needs the extra `denoise`


@torch.no_grad()
def quick_picture(subject: Subject, cameras: Cameras, look: Look) -> Tensor:
    """View 0 with few samples, from the mesh only: [H, W, 4] sRGB with straight alpha; a UserError
    of expected errors without photographs."""
    rays = image_rays(cameras, 0)
    surface, wo, hit = surface_along(subject, rays)
    if look.layer == "expected error":  # in the colours of `univoxel eval`
        colors = torch.from_numpy(
            heat(at_hits(subject.traced.mesh, hit, subject.albedo_error), ALBEDO_LIMIT)
        )
        return _grid(cameras, torch.cat([colors.float(), surface.opacity[:, None]], 1))
    if look.layer != "render":
        return _layer(subject, cameras, look.layer, surface)
    rgb = relight_surface(
        surface, wo, subject.traced, look.lighting, samples=QUICK_SAMPLES, bounces=QUICK_BOUNCES
    )
    shadow = None
    if look.ground:
        hidden = surface.opacity > 0
        shadow = _shadow(subject, look, rays, hidden, FLOOR_SAMPLES, QUICK_BOUNCES, 0)
    return _composed(cameras, look, surface, rgb, shadow)


@torch.no_grad()
def refined_pictures(
    subject: Subject, cameras: Cameras, look: Look, samples: int = MOST_SAMPLES
) -> Iterator[Tensor | None]:
    """View 0 as `univoxel relight` renders it, better with every pass, up to so many samples per
    pixel: [H, W, 4] as above. Without noise, from the first samples on, where the look asks for
    that.

    Between pictures comes None, after every step of about 0.1 s: a caller who has something more
    urgent to do leaves then.
    """
    yield quick_picture(subject, cameras, look)
    if look.layer == "expected error":
        return
    rays = image_rays(cameras, 0)
    steps = []
    for index in torch.arange(len(rays.origin)).split(STEP_RAYS):
        steps.append(surface_at(subject.scene, _at(rays, index)))
        yield None
    surface, wo = joined(steps), -rays.direction
    if look.layer != "render":
        yield _layer(subject, cameras, look.layer, surface)
        return
    passes = _passes(subject, cameras, look, surface, wo, samples)
    for found in _denoised(passes, cameras, surface) if look.denoise else passes:
        yield None if found is None else _composed(cameras, look, surface, *found)


Light: TypeAlias = "tuple[Tensor, Tensor | None]"  # of pixels [N, 3], and a floor's shadow [N]


def _passes(
    subject: Subject, cameras: Cameras, look: Look, surface: Surface, wo: Tensor, samples: int
) -> Iterator[Light | None]:
    """The light of pixels after each pass, better and better; None after each step of one."""
    rays = image_rays(cameras, 0)
    rgb, shadow = torch.zeros_like(wo), wo.new_zeros(len(wo)) if look.ground else None
    hit = (surface.opacity > 0).nonzero()[:, 0]
    floor = (surface.opacity <= 0.999).nonzero()[:, 0] if look.ground else hit[:0]
    done, number = 0, 0
    while done < samples:
        more = min(PASSES[min(number, len(PASSES) - 1)], samples - done)
        share = more / (done + more)
        for some in _steps(hit, more):
            found = relight_surface(
                at_rays(surface, some),
                wo[some],
                subject.traced,
                look.lighting,
                samples=more,
                bounces=BOUNCES,
                first=done,
                seed=int(some[0]),  # other noise than in other steps
            )
            rgb[some] += share * (found - rgb[some])
            yield None
        if shadow is not None:
            for some in _steps(floor, 2 * more):
                hidden = torch.zeros(len(some), dtype=torch.bool)
                seed = (int(some[0]) + 0x9E3779B9 * number) % 2**32
                found = _shadow(subject, look, _at(rays, some), hidden, more, BOUNCES, seed)
                shadow[some] += share * (found - shadow[some])
                yield None
        done, number = done + more, number + 1
        yield rgb, shadow


def _denoised(
    passes: Iterator[Light | None], cameras: Cameras, surface: Surface
) -> Iterator[Light | None]:
    """The same passes without their noise, while the next are made; the first with it, too.

    Of passes that end while one is denoised the last one follows.
    """
    running: Future[Light] | None = None
    waiting: Light | None = None
    clean = False
    for found, over in chain(((light, False) for light in passes), repeat((None, True))):
        if over:
            if running is None:
                return
            wait([running], WAIT_SECONDS)
        elif found is not None:
            waiting = found
            if not clean:
                yield found
        if running is not None and running.done():
            yield running.result()
            running, clean = None, True
        if running is None and waiting is not None:
            rgb, shadow = waiting  # which the next passes change
            copies = rgb.clone(), None if shadow is None else shadow.clone()
            running, waiting = _BESIDE.submit(_without_noise, cameras, surface, *copies), None
        yield None


def _without_noise(cameras: Cameras, surface: Surface, rgb: Tensor, shadow: Tensor | None) -> Light:
    """The light of pixels, linear, and a floor's shadow, guided by albedo and normals."""
    import pyoidn  # pyright: ignore[reportMissingImports]  the extra `denoise`

    def array(values: Tensor) -> np.ndarray:
        return np.ascontiguousarray(_grid(cameras, values).numpy(), np.float32)

    hit = surface.opacity[:, None] > 0
    guides = {"albedo": surface.albedo, "normal": surface.normal}
    aside = {name: array(torch.where(hit, values, 0)) for name, values in guides.items()}
    light = torch.from_numpy(pyoidn.denoise(array(rgb), **aside, hdr=True)).clamp_min(0)
    if shadow is None:
        return light.reshape(-1, 3), None
    grey = torch.from_numpy(pyoidn.denoise(array(shadow[:, None].expand(-1, 3))))
    return light.reshape(-1, 3), grey[..., 0].clamp(0, 1).reshape(-1)


def _steps(pixels: Tensor, samples: int) -> Iterable[Tensor]:
    """Pixels in parts of a step each."""
    return pixels.split(max(1, STEP_PATHS // samples)) if len(pixels) else ()


def _at(rays: Rays, index: Tensor) -> Rays:
    return Rays(rays.origin[index], rays.direction[index])


def _shadow(
    subject: Subject, look: Look, rays: Rays, hidden: Tensor, samples: int, bounces: int, seed: int
) -> Tensor:
    """What a floor under the object loses of its light: [N]."""
    return ground_shadow(
        rays,
        subject.ground,
        subject.traced,
        look.lighting,
        samples=samples,
        bounces=bounces,
        hidden=hidden,
        seed=seed,
    )


def _composed(
    cameras: Cameras, look: Look, surface: Surface, rgb: Tensor, shadow: Tensor | None
) -> Tensor:
    """Object, floor and backdrop together: [H, W, 4] sRGB with straight alpha."""
    opacity = surface.opacity[:, None]
    rgb, clear = rgb * opacity, 1 - opacity
    if shadow is not None:
        clear = clear * (1 - shadow[:, None])
    alpha = 1 - clear
    if look.backdrop:
        sky = env.background(look.lighting.tables, image_rays(cameras, 0).direction)
        rgb, alpha = rgb + clear * sky, torch.ones_like(alpha)
    straight = 2**look.exposure * rgb / alpha.clamp_min(1e-6)
    return _grid(cameras, torch.cat([linear_to_srgb(straight), alpha.clamp(0, 1)], 1))


def _layer(subject: Subject, cameras: Cameras, layer: Layer, surface: Surface) -> Tensor:
    """A layer but for render and expected error: [H, W, 4] sRGB with straight alpha."""
    match layer:
        case "albedo":
            values = linear_to_srgb(surface.albedo)
        case "normal":
            values = 0.5 * surface.normal + 0.5
        case "roughness":
            values = surface.roughness[:, None].expand(-1, 3)
        case "metal":
            metal = metal_or_none(surface.metallic)
            metal = torch.zeros_like(surface.depth) if metal is None else metal
            values = metal[:, None].expand(-1, 3)
        case _:  # depth along -Z: 1 at the object's nearest point, 0 at its farthest
            place, back = cameras.camera_to_world[0, :, 3], cameras.camera_to_world[0, :, 2]
            ends = -(subject.traced.mesh.vertices - place) @ back
            depth = -(surface.position - place) @ back
            nearness = 1 - (depth - ends.min()) / (ends.max() - ends.min()).clamp_min(1e-9)
            values = nearness[:, None].expand(-1, 3)
    return _grid(cameras, torch.cat([values.clamp(0, 1), surface.opacity[:, None]], 1))


def _grid(cameras: Cameras, values: Tensor) -> Tensor:
    width, height = cameras.size(0)
    return values.reshape(height, width, -1)
