"""Draws the pictures of the tankard: docs/images/tankard.webp, which moves, and tankard.jpg.

    univoxel train mary_rose_tankard --out RUN
    python docs/figures/tankard.py RUN docs/images

The photographs are vork/maryRose by Daniel Pett, masks and poses by Mark Boss, CC BY 4.0. They show
the tankard lying on its side; the pictures are turned so that it is upright.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image

import univoxel
from univoxel import sphere
from univoxel.camera import Cameras, resize
from univoxel.color import linear_to_srgb
from univoxel.detail.texture import albedo_near
from univoxel.envmap import EnvMap, lookup, read_map
from univoxel.evaluation.measures import render_layers
from univoxel.run import photos_of

MAPS = Path(univoxel.__file__).parent / "example_data/tiny/envmaps"
VIEW, FRAMES, SIDE, STILL = 0, 32, 400, 480
BALL = 84  # pixels, of the mirror ball that shows the light
BACK = (236, 236, 238)


def upright(picture: Image.Image, side: int) -> Image.Image:
    """Over the background, turned, cut to the object and square."""
    plate = Image.new("RGBA", picture.size, (*BACK, 255))
    plate.alpha_composite(picture.convert("RGBA"))
    turned = plate.convert("RGB").transpose(Image.Transpose.ROTATE_270)
    return turned.resize((side, side), Image.Resampling.LANCZOS)


def straight(rgba: torch.Tensor) -> Image.Image:
    """An image of linear premultiplied [H, W, 4]."""
    alpha = rgba[..., 3:]
    color = linear_to_srgb((rgba[..., :3] / alpha.clamp_min(1e-4)).clamp(0, 1))
    pixels = torch.cat([color, alpha.clamp(0, 1)], -1)
    return Image.fromarray((255 * pixels.numpy() + 0.5).astype(np.uint8), "RGBA")


def turned(light: EnvMap, camera: torch.Tensor, degrees: float) -> EnvMap:
    """The map turned about the vertical of the upright picture, and upright in it."""
    right, up, back = camera[:, :3].T
    axes = torch.stack([back, up, -right])  # rows: what the map has as +X, +Y, +Z
    angle = torch.tensor(degrees).deg2rad()
    c, s = float(angle.cos()), float(angle.sin())
    axes = torch.tensor([[c, s, 0], [-s, c, 0], [0, 0, 1.0]]) @ axes
    direction = sphere.latlong_directions(len(light.radiance))
    return EnvMap(lookup(light, direction @ axes.T).float().contiguous())


def chosen(photos, width: int) -> Cameras:
    return resize(photos.cameras.of(torch.tensor([VIEW])), width)


@torch.no_grad()
def main(run: Path, out: Path) -> None:
    found = univoxel.open_run(run)
    photos = found.scene.registered(photos_of(run))
    color, alpha = photos.picture(VIEW)
    photograph = straight(torch.cat([color * alpha[..., None], alpha[..., None]], -1))
    layers = render_layers(found.scene, chosen(photos, 2 * STILL), 0, None, None, albedo_near(run))
    there = layers.alpha[..., None]
    grey = layers.roughness[..., None].expand(-1, -1, 3) ** 2.2 * there
    normal = ((layers.normal + 1) / 2) ** 2.2 * there
    views = [
        torch.cat([x, there], -1)
        for x in (layers.rgb, 0.8 * layers.albedo / layers.albedo.quantile(0.98), grey, normal)
    ]
    camera = photos.cameras.camera_to_world[VIEW]
    sunset, city = (read_map(MAPS / f"{name}.hdr") for name in ("sunset", "city"))

    def relit(light: EnvMap, degrees: float, side: int, samples: int) -> Image.Image:
        seen = turned(light, camera, degrees)
        cameras = chosen(photos, side)
        picture = found.relight(seen, cameras=cameras, samples=samples, exposure=EXPOSURE)[0]
        return straight(picture)

    stills = [photograph, *map(straight, views), relit(city, 0, 2 * STILL, 64)]
    row = [upright(s, STILL) for s in stills]
    sheet = Image.new("RGB", (3 * STILL + 16, 2 * STILL + 8), "white")
    for k, picture in enumerate(row):
        sheet.paste(picture, (k % 3 * (STILL + 8), k // 3 * (STILL + 8)))
    sheet.save(out / "tankard.jpg", quality=88)

    frames = []
    for frame in range(FRAMES):
        degrees = 360 * frame / FRAMES
        panel = upright(relit(sunset, degrees, SIDE, 32), SIDE)
        # what a chrome ball beside the object would show to this camera
        ball = mirror(turned(sunset, camera, degrees), camera)
        panel.paste(ball, (SIDE - BALL - 8, 8), ball)
        strip = Image.new("RGB", (3 * SIDE, SIDE), BACK)
        for k, picture in enumerate((stills[0], stills[2])):
            strip.paste(upright(picture, SIDE), (k * SIDE, 0))
        strip.paste(panel, (2 * SIDE, 0))
        frames.append(strip)
    frames[0].save(
        out / "tankard.webp",
        save_all=True,
        append_images=frames[1:],
        duration=90,
        loop=0,
        quality=78,
        method=6,
    )


def mirror(light: EnvMap, camera: torch.Tensor) -> Image.Image:
    at = (torch.arange(2 * BALL) + 0.5) / BALL - 1
    y, x = torch.meshgrid(-at, at, indexing="ij")
    inside = (x**2 + y**2) < 1
    z = (1 - x**2 - y**2).clamp_min(0).sqrt()
    right, up, back = camera[:, :3].T
    # axes of the upright picture
    normal = x[..., None] * up + y[..., None] * -right + z[..., None] * back
    reflected = 2 * (normal @ back)[..., None] * normal - back
    rgb = linear_to_srgb((EXPOSURE * lookup(light, reflected)).clamp(0, 1))
    pixels = torch.cat([rgb, inside[..., None].float()], -1).numpy()
    image = Image.fromarray((255 * pixels + 0.5).astype(np.uint8), "RGBA")
    return image.resize((BALL, BALL), Image.Resampling.LANCZOS)


EXPOSURE = 1.6


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
