"""Composed images: contact sheets, spheres under a map, thumbnails, previews of a scene."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, interpolate

from univoxel.color import linear_to_srgb
from univoxel.core.records import AlbedoNear
from univoxel.data import Photos
from univoxel.data.images import write_png
from univoxel.envmap import EnvMap, lookup
from univoxel.render.pipeline import shade_hits, surface_of_view
from univoxel.scene import Scene
from univoxel.sphere import latlong_directions, texel_solid_angles

TILE = 160  # pixels; larger pictures are shrunk
GAP, LABEL = 4, 18  # pixels
# A ramp that also rises in brightness, so that it reads without colour.
HEAT = np.array(
    [[0, 0, 0], [0.35, 0.05, 0.45], [0.85, 0.2, 0.25], [1, 0.7, 0.1], [1, 1, 0.9]], np.float32
)


@dataclass(frozen=True)
class Panel:
    """One quantity of one view."""

    title: str  # such as albedo
    estimate: Tensor  # [H, W, 3] sRGB in [0, 1]
    truth: Tensor | None  # [H, W, 3], or nothing to compare with
    error: Tensor | None  # [H, W] >= 0
    limit: float  # the error that is drawn brightest
    unit: str = ""  # of the error
    heads: tuple[str, str] = ("truth", "error")  # of the second and third column


def heat(error: Tensor, limit: float) -> np.ndarray:
    """Errors [H, W] as colours [H, W, 3] in [0, 1]: black is 0, near white is `limit` or more."""
    x, steps = error.numpy() / limit, np.linspace(0, 1, len(HEAT))
    return np.stack([np.interp(x, steps, channel) for channel in HEAT.T], -1)


def contact_sheet(rows: list[tuple[str, list[Panel]]]) -> np.ndarray:
    """Draw views as rows and, for each quantity, estimate, truth and error as columns.

    Args:
        rows: the name and the panels of each view; all views have the same quantities.

    Returns:
        [H, W, 3] uint8 sRGB.

    Raises:
        ValueError: no rows, or rows with differing quantities.
    """
    titles = [[panel.title for panel in panels] for _, panels in rows]
    if not rows or any(t != titles[0] for t in titles) or not titles[0]:
        raise ValueError(f"contact_sheet: expected rows with the same panels, got {titles}")
    sizes = [_tile_size(panels[0].estimate) for _, panels in rows]
    cell = max(TILE, *(width for width, _ in sizes)) + GAP  # titles need their room, too
    margin = 8 + 8 * max(len(name) for name, _ in rows)
    sheet = Image.new(
        "RGB",
        (margin + 3 * cell * len(titles[0]), LABEL + sum(height + GAP for _, height in sizes)),
        (32, 32, 32),
    )
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(12)
    for column, panel in enumerate(rows[0][1]):
        second, third = panel.heads
        texts = (panel.title, second, f"{third}, 0 to {panel.limit:g}{panel.unit}")
        for k, text in enumerate(texts):
            draw.text((margin + (3 * column + k) * cell, 2), text, "white", font)
    y = LABEL
    for (name, panels), (width, height) in zip(rows, sizes, strict=True):
        draw.text((4, y + height // 2 - 6), name, "white", font)
        for column, panel in enumerate(panels):
            error = None if panel.error is None else heat(panel.error, panel.limit)
            tiles = (panel.estimate.numpy(), panel.truth, error)
            for k, tile in enumerate(tiles):
                if tile is not None:
                    x = margin + (3 * column + k) * cell
                    sheet.paste(_tile(np.asarray(tile), width, height), (x, y))
        y += height + GAP
    return np.asarray(sheet)


def shrink(panel: Panel) -> Panel:
    """The panel at about the size it is drawn in, so that sheets of large views fit in memory."""
    every = max(1, min(panel.estimate.shape[:2]) // (2 * TILE))
    tensors = {name: x for name, x in vars(panel).items() if isinstance(x, Tensor)}
    return replace(panel, **{name: x[::every, ::every].clone() for name, x in tensors.items()})


def _tile_size(picture: Tensor) -> tuple[int, int]:
    """Width and height that a picture [H, W, 3] is drawn in."""
    scale = min(1.0, TILE / max(picture.shape[:2]))
    height, width = (max(1, round(scale * n)) for n in picture.shape[:2])
    return width, height


def _tile(picture: np.ndarray, width: int, height: int) -> Image.Image:
    bytes_ = (np.clip(picture, 0, 1) * 255 + 0.5).astype(np.uint8)
    return Image.fromarray(bytes_).resize((width, height), Image.Resampling.BOX)


# A map of light as pictures: itself, and a grey and a chrome sphere under it.


GREY = 0.5  # albedo of the ball
TEXELS = 64  # rows of the map that light is summed over
BLOCK = 64  # normals at a time: what each gets of every texel stays in the cache


def map_and_balls(map: Tensor, height: int) -> list[Tensor]:
    """A map, and a grey and a chrome sphere under it, seen from +X: linear, `height` rows each."""
    normal, inside = _ball(height)
    grey = torch.zeros(height, height, 3)
    grey[inside] = grey_ball(map, normal[inside])
    return [lookup(EnvMap(map), latlong_directions(height)), grey, mirror_ball(map, height)]


def mirror_ball(map: Tensor, height: int) -> Tensor:
    """A ball [height, height, 3] that mirrors a map, seen from +X: linear, black around it."""
    normal, inside = _ball(height)
    mirrored = 2 * normal[..., :1] * normal - torch.tensor([1.0, 0.0, 0.0])
    return torch.where(inside[..., None], lookup(EnvMap(map), mirrored), 0.0)


def grey_ball(map: Tensor, normal: Tensor) -> Tensor:
    """Radiance [N, 3] of a Lambertian ball of albedo GREY at unit normals [N, 3]."""
    direction, light = summed_light(map)
    reached = [(part @ direction.T).clamp_min_(0) @ light for part in normal.split(BLOCK)]
    return GREY / math.pi * torch.cat(reached)


def _ball(height: int) -> tuple[Tensor, Tensor]:
    """Normals [height, height, 3] of a ball seen from +X, and where it is [height, height]."""
    y, z = torch.meshgrid(*2 * [(2 * torch.arange(height) + 1) / height - 1], indexing="xy")
    depth = 1 - y * y - z * z
    return torch.stack([depth.clamp_min(0).sqrt(), y, -z], -1), depth > 0


def summed_light(map: Tensor) -> tuple[Tensor, Tensor]:
    """Directions [M, 3] and radiance times solid angle [M, 3] of a map, pooled to few texels."""
    height, width, _ = map.shape
    rows = min(height, TEXELS)
    light = (map * texel_solid_angles(height, width)[..., None]).movedim(2, 0)
    pooled = adaptive_avg_pool2d(light, (rows, 2 * rows)).flatten(1).T
    return latlong_directions(rows).flatten(0, 1), pooled * (light[0].numel() / len(pooled))


# Photographs as small as what is beside them.


def shrunk(photos: Photos, view: int, width: int, height: int) -> Tensor:
    """A photograph by areas: [height, width, 4] linear, premultiplied."""
    color, alpha = photos.picture(view)
    stored = torch.cat([color * alpha[..., None], alpha[..., None]], -1).movedim(-1, 0)
    return interpolate(stored[None], (height, width), mode="area")[0].movedim(0, -1)


# Pictures of a scene's present state.


def preview(
    scene: Scene, photos: Photos, path: Path, albedo_near: AlbedoNear | None = None
) -> None:
    """The first photograph beside what the scene says of it: render, albedo, roughness, normal."""
    width, height = photos.cameras.size(0)
    surface, wo = surface_of_view(scene, photos.cameras, 0, albedo_near)
    color, alpha = photos.picture(0)
    opacity = surface.opacity[:, None]
    tiles = [
        linear_to_srgb(color * alpha[..., None]),
        linear_to_srgb(shade_hits(scene, surface, wo, 0)),
        linear_to_srgb(surface.albedo * opacity),
        surface.roughness[:, None].expand(-1, 3) * opacity,
        (0.5 + 0.5 * surface.normal) * opacity,
    ]
    write_png(path, torch.cat([t.reshape(height, width, 3) for t in tiles], 1))
