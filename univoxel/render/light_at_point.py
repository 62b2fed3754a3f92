"""The light that reaches one point of a trained scene, as an image."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from univoxel.camera import pixel_rays
from univoxel.color import linear_to_srgb, luminance
from univoxel.core.records import Rays, Surface
from univoxel.data import Photos
from univoxel.data.truth import read_ply
from univoxel.envmap import EnvMap, lookup, true_map
from univoxel.errors import UserError
from univoxel.ops import VisibilityScene
from univoxel.render.pipeline import occlusion_rays, trace_and_shade
from univoxel.scene import Scene
from univoxel.sphere import latlong_directions, texel_solid_angles

LABEL = 18  # pixels of height
BEHIND = 0.3  # brightness of directions from below the point's horizon, which do not count


@dataclass(frozen=True)
class Incident:
    """Light that arrives at a point, [H, 2 H] over the sphere."""

    title: str
    radiance: Tensor  # [H, 2 H, 3] linear
    visible: Tensor | None = None  # [H, 2 H] bool: from the distant map, not from the object itself


def arriving(scene: Scene, surface: Surface, height: int) -> list[Incident]:
    """What the scene knows of the light at one surface point."""
    wi = latlong_directions(height).flatten(0, 1)[None]
    shape = (height, 2 * height)
    layers = []
    if not scene.light.traced:
        coded = replace(surface, features=scene.coded(surface.features))
        radiance = scene.exposed(scene.light.incident(coded, wi)[0])
        layers.append(Incident(f"local {scene.cfg.light.kind}", radiance.view(*shape, 3)))
    sky = scene.environment()
    if sky is not None:
        visible, indirect = trace_and_shade(scene, *occlusion_rays(scene, surface, wi))
        radiance = torch.where(visible[:, None], sky.latlong(height).flatten(0, 1), indirect)
        radiance = scene.exposed(radiance)
        layers.append(Incident("map", radiance.view(*shape, 3), visible.view(shape)))
    return layers


def true_light(scene: Scene, data: Path, rays: Rays, height: int) -> Incident | None:
    """The true map through the true mesh at the place that one ray meets on it.

    Nothing where the data set lacks either, or the ray passes the mesh by.
    """
    map, path = true_map(data), data / "mesh.ply"
    if map is None or not path.is_file():
        return None
    mesh = read_ply(path)
    tracer = VisibilityScene(mesh.vertices, mesh.faces)
    hit = tracer.closest_hit(rays.origin, rays.direction)
    if hit.face[0] < 0:
        return None
    place = rays.origin[0] + hit.t[0] * rays.direction[0]
    a, b, c = mesh.vertices[mesh.faces[hit.face[0]].long()]
    normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=0)
    if normal @ rays.direction[0] > 0:
        normal = -normal
    wi = latlong_directions(height).flatten(0, 1)
    start = place + 1e-4 * hit.t[0] * normal  # off its own triangle
    visible, indirect = trace_and_shade(scene, start.expand_as(wi).contiguous(), wi, tracer)
    radiance = torch.where(visible[:, None], lookup(EnvMap(map), wi), indirect)
    return Incident("truth", radiance.view(height, -1, 3), visible.view(height, -1))


def irradiance(radiance: Tensor, normal: Tensor) -> Tensor:
    """[3] on a surface of unit normal [3] under light [H, 2 H, 3] from everywhere."""
    height, width, _ = radiance.shape
    cosine = (latlong_directions(height) @ normal).clamp_min(0)
    return (radiance * (cosine * texel_solid_angles(height, width))[..., None]).sum((0, 1))


def ray_of(photos: Photos, view: int, pixel: tuple[int, int]) -> Rays:
    size = photos.cameras.size(view)
    if not all(0 <= p < n for p, n in zip(pixel, size, strict=True)):
        raise UserError(
            f"pixel: expected a pixel of a {size[0]}x{size[1]} image, got {pixel[0]},{pixel[1]}",
            "pixel",
        )
    return pixel_rays(photos.cameras, torch.tensor([view]), torch.tensor([pixel]) + 0.5)


def sheet(
    photos: Photos,
    view: int,
    pixel: tuple[int, int],
    surface: Surface,
    layers: list[Incident],
    truth: Incident | None,
) -> np.ndarray:
    """[H, W, 3] uint8: the marked photograph, and beside it the layers one under another."""
    normal = surface.normal[0]
    if truth:
        wanted = irradiance(truth.radiance, normal)
        for i, layer in enumerate(layers):
            factor = wanted / irradiance(layer.radiance, normal).clamp_min(1e-6)
            title = f"{layer.title}, x " + " ".join(f"{f:.2f}" for f in factor.tolist())
            layers[i] = replace(layer, title=title, radiance=layer.radiance * factor)
        layers = [*layers, truth]
    exposure = 1 / luminance(layers[-1].radiance).quantile(0.9).clamp_min(1e-6)
    height, width, _ = layers[0].radiance.shape
    below = latlong_directions(height) @ normal < 0
    color, alpha = photos.picture(view)
    scale = width / max(color.shape[:2])
    photo = _image(linear_to_srgb(color * alpha[..., None]))
    photo = photo.resize([max(1, round(scale * n)) for n in photo.size], Image.Resampling.BICUBIC)
    rows = len(layers) * (height + LABEL)
    sheet = Image.new("RGB", (photo.width + 4 + width, max(rows, photo.height + LABEL)), (32,) * 3)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(12)
    draw.text((4, 2), f"{photos.names[view]}, pixel {pixel[0]},{pixel[1]}", "white", font)
    sheet.paste(photo, (0, LABEL))
    x, y = (scale * (p + 0.5) for p in pixel)
    for radius, ink in ((7, "black"), (6, "red"), (5, "red")):
        box = (x - radius, LABEL + y - radius, x + radius, LABEL + y + radius)
        draw.ellipse(box, outline=ink)
    for i, layer in enumerate(layers):
        top = i * (height + LABEL)
        draw.text((photo.width + 8, top + 2), layer.title, "white", font)
        shown = linear_to_srgb(layer.radiance * exposure)
        shown = torch.where(below[..., None], BEHIND * shown, shown)
        sheet.paste(_image(shown), (photo.width + 4, top + LABEL))
    return np.asarray(sheet)


def _image(srgb: Tensor) -> Image.Image:
    return Image.fromarray((srgb.clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy())
