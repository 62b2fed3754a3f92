"""The light that falls on one point of a trained scene, as a picture."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from univoxel.camera import pixel_rays
from univoxel.checkpoint import load_scene
from univoxel.color import linear_to_srgb, luminance
from univoxel.data import Photos
from univoxel.data.images import write_exr, write_png
from univoxel.data.maps import true_map
from univoxel.data.mesh import read_ply
from univoxel.envmap import EnvMap, lookup
from univoxel.errors import UserError
from univoxel.names import MAP_ROWS
from univoxel.ops import VisibilityScene
from univoxel.records import Rays, Surface
from univoxel.render.occlusion import occlusion_rays, trace_and_shade
from univoxel.render.pipeline import surface_at
from univoxel.run import photos_of
from univoxel.scene import Scene
from univoxel.sphere import latlong_directions, texel_solid_angles

MIN_OPACITY = 0.5  # of a pixel that has a surface
LABEL = 18  # pixels of height
BEHIND = 0.3  # brightness of directions from below the point's horizon, which do not count


@dataclass(frozen=True)
class Incident:
    """Light that arrives at a point, [H, 2 H] over the sphere."""

    title: str
    radiance: Tensor  # [H, 2 H, 3] linear
    visible: Tensor | None = None  # [H, 2 H] bool: from the distant map, not from the object itself


@torch.no_grad()
def inspect(
    run: str | Path,
    view: str,
    pixel: tuple[int, int],
    out: str | Path | None = None,
    height: int = MAP_ROWS,
    light_of: str | None = None,
) -> Path:
    """Draw the light that a scene says falls on the surface under a pixel; returns the picture.

    The PNG holds a lat-long picture for each thing the scene knows: its local light, its distant
    map as the object itself hides it, with what hides it lit as the radiance head says; and the
    truth, where the data set has mesh.ply and envmaps/train.hdr or .exr: the true map as the true
    mesh hides it, with the same bounces. Each is brought to the truth's irradiance by a factor per
    channel, that photographs hardly fix. Directions from below the horizon are dimmed. On the left
    the photograph, with the point marked. The EXR beside it holds everything as it is:
    <layer>.R .G .B, <layer>.open.

    Args:
        run: folder of a trained run.
        view: name or number of a test view.
        pixel: column and row.
        out: .png; in the run's folder when left out.
        height: rows of the lat-long pictures, >= 1.
        light_of: training view, by name or number, whose light it is, where light varies; their
            mean when left out.

    Raises:
        DataError: the run or its data cannot be read.
        UserError: no such view or pixel, or no surface under it; an argument out of range;
            light_of is no training view, or light does not vary.
        OSError: a file cannot be written.
    """
    run, out = Path(run), None if out is None else Path(out)
    if height < 1:
        raise UserError(f"inspect: height must be at least 1, got {height}", "height")
    if out is not None and out.suffix.lower() != ".png":
        raise UserError(f"out: expected a name that ends in .png, got {out}", "out")
    scene = load_scene(run)
    scene.show_light_of(light_of)
    photos = photos_of(run)
    index = _view(photos, view)
    rays = _ray(photos, index, pixel)
    surface = surface_at(scene, rays)
    if not surface.opacity[0] > MIN_OPACITY:
        raise UserError(f"pixel: there is no surface under {pixel[0]},{pixel[1]}", "pixel")
    layers = arriving(scene, surface, height)
    truth = true_light(scene, photos.folder, rays, height)
    out = out or run / "inspect" / f"{photos.names[index]}_{pixel[0]}_{pixel[1]}.png"
    out.parent.mkdir(parents=True, exist_ok=True)
    channels = {}
    for layer in [*layers, *([truth] if truth else [])]:
        key = layer.title.replace(" ", "_")
        channels |= {f"{key}.{c}": x for c, x in zip("RGB", layer.radiance.unbind(2), strict=True)}
        if layer.visible is not None:
            channels[f"{key}.open"] = layer.visible.float()
    write_exr(out.with_suffix(".exr"), channels, half=False)
    write_png(out, _sheet(photos, index, pixel, surface, layers, truth))
    return out


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


def parse_pixel(text: str) -> tuple[int, int]:
    """Column and row as the command line writes them.

    Raises:
        UserError: not two whole numbers.
    """
    try:
        column, row = (int(part) for part in text.split(","))
    except ValueError:
        raise UserError(f"pixel: expected COLUMN,ROW, got {text!r}", "pixel") from None
    return column, row


def _view(photos: Photos, view: str) -> int:
    if view in photos.names:
        return photos.names.index(view)
    if view.isdigit() and int(view) < len(photos):
        return int(view)
    raise UserError(
        f"view: expected a number below {len(photos)} or one of {photos.names[0]} to "
        f"{photos.names[-1]}, got {view!r}",
        "view",
    )


def _ray(photos: Photos, view: int, pixel: tuple[int, int]) -> Rays:
    size = photos.cameras.size(view)
    if not all(0 <= p < n for p, n in zip(pixel, size, strict=True)):
        raise UserError(
            f"pixel: expected one of the {size[0]}x{size[1]} pixels, got {pixel[0]},{pixel[1]}",
            "pixel",
        )
    return pixel_rays(photos.cameras, torch.tensor([view]), torch.tensor([pixel]) + 0.5)


def _sheet(
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
