"""Draws docs/images/real.jpg and docs/images/sneaker.png: a photograph, and its model.

    univoxel poses ethiopian_head/images --masks ethiopian_head/masks --out HEAD
    univoxel train HEAD --out RUN --preset fast
    python docs/figures/model.py RUN docs/images/real.jpg MAP.hdr MAP.hdr

    univoxel train sneaker --out RUN --preset fast
    python docs/figures/model.py RUN docs/images/sneaker.png MAP.hdr MAP.hdr \\
        --layers albedo roughness normal

From the left: a photograph that training did not see, on black; the render; the layers; the model
under each map. The head is vork/ethiopianHead, photographs by Daniel Pett (British Museum),
CC BY-NC-SA 4.0: what is made from it names it, and is under the same licence.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor

import univoxel
from univoxel.camera import Cameras
from univoxel.color import linear_to_srgb
from univoxel.pictures.layers import Layers, render_layers
from univoxel.run import photos_of
from univoxel.tasks.relight import relight_images

LONGER, GAP = 300, 4  # pixels of a picture's longer side, and between two
MARGIN = 0.03  # of that side, around the object
BRIGHT = 0.7  # sRGB of the picture's brightest hundredth; a light of other strength is scaled
QUALITY = 85  # of a JPEG, which stays below 200 kB


def one(cameras: Cameras, view: int) -> Cameras:
    """The camera of one view."""
    return Cameras(
        cameras.camera_to_world[view : view + 1],
        cameras.focal[view : view + 1],
        cameras.centre[view : view + 1],
        *cameras.size(view),
    )


def frame(alpha: Tensor) -> tuple[int, int, int, int]:
    """The box around what is opaque in a photograph's alpha [H, W], for `Image.crop`."""
    rows, columns = (alpha > 0.5).any(1).nonzero(), (alpha > 0.5).any(0).nonzero()
    margin = round(MARGIN * max(alpha.shape))
    return (
        max(int(columns[0]) - margin, 0),
        max(int(rows[0]) - margin, 0),
        min(int(columns[-1]) + margin, alpha.shape[1]),
        min(int(rows[-1]) + margin, alpha.shape[0]),
    )


def picture(linear: Tensor, exposed: bool = False) -> Image.Image:
    """Linear colours [H, W, 3] on black as a picture; exposed: scaled so that they are bright."""
    if exposed:
        luminance = linear.mean(-1)
        linear = linear * (BRIGHT**2.2 / luminance[luminance > 0].quantile(0.99))
    return encoded(linear_to_srgb(linear.clamp(0, 1)))


def encoded(values: Tensor) -> Image.Image:
    """Values [H, W, 3] in [0, 1] as a picture."""
    return Image.fromarray((255 * values).round().byte().numpy())


def layer(layers: Layers, name: str) -> Image.Image:
    """One of a view's layers, as `univoxel view` paints it."""
    if name == "albedo":
        return picture(layers.albedo, exposed=True)
    if name == "roughness":
        return encoded(layers.roughness.clamp(0, 1)[..., None].expand(-1, -1, 3).contiguous())
    there = layers.alpha[..., None]
    return encoded((0.5 * layers.normal + 0.5).clamp(0, 1) * there)


@torch.no_grad()
def main(path: Path, out: Path, maps: list[Path], names: list[str], view: int) -> None:
    """Render and put side by side."""
    run = univoxel.open_run(path)
    photos = photos_of(path)
    color, alpha = photos.picture(view)
    camera = one(photos.cameras, view)
    layers = render_layers(run.scene, camera, 0)
    pictures = [picture(color * alpha[..., None]), picture(layers.rgb)]
    pictures += [layer(layers, name) for name in names]
    for name in maps:
        relit = relight_images(path, name, camera, samples=256)[0, ..., :3]
        pictures.append(picture(relit, exposed=True))
    box = frame(alpha)
    scale = LONGER / max(box[2] - box[0], box[3] - box[1])
    size = round(scale * (box[2] - box[0])), round(scale * (box[3] - box[1]))
    row = Image.new("RGB", (len(pictures) * (size[0] + GAP) - GAP, size[1]), "white")
    for i, shown in enumerate(pictures):
        small = shown.crop(box).resize(size, Image.Resampling.LANCZOS)
        row.paste(small, (i * (size[0] + GAP), 0))
    options = {"quality": QUALITY} if out.suffix == ".jpg" else {}
    row.save(out, optimize=True, **options)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="a photograph, and the model it belongs to")
    parser.add_argument("run", type=Path, help="a run")
    parser.add_argument("out", type=Path, help="the picture to write, .jpg or .png")
    parser.add_argument("maps", type=Path, nargs="*", help="environment maps to light it with")
    parser.add_argument("--layers", nargs="+", default=["albedo"], help="albedo, roughness, normal")
    parser.add_argument("--view", type=int, default=0, help="which test view")
    given = parser.parse_args()
    main(given.run, given.out, given.maps, given.layers, given.view)
