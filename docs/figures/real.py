"""Draws docs/images/real.jpg: a photograph of a real object, and its model in other light.

    univoxel poses ethiopian_head/images --masks ethiopian_head/masks --out HEAD
    univoxel train HEAD --out RUN --preset fast
    python docs/figures/real.py RUN docs/images MAP.hdr MAP.hdr

From the left: a photograph that training did not see, on black; the render; the albedo; the model
under each map. The capture is vork/ethiopianHead, photographs by Daniel Pett (British Museum),
CC BY-NC-SA 4.0: what is made from it names it, and is under the same licence.
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor

import univoxel
from univoxel.camera import Cameras, resize
from univoxel.color import linear_to_srgb
from univoxel.pictures.layers import render_layers
from univoxel.run import photos_of
from univoxel.tasks.relight import relight_images

VIEW = 0  # of the test views: the face
SIDE, GAP = 300, 4  # pixels of a picture, and between two
BRIGHT = 0.7  # sRGB of the picture's brightest hundredth; a light of other strength is scaled
QUALITY = 85  # of the JPEG, which stays below 200 kB


def one(cameras: Cameras, view: int) -> Cameras:
    """The camera of one view, in a small picture."""
    alone = Cameras(
        cameras.camera_to_world[view : view + 1],
        cameras.focal[view : view + 1],
        cameras.centre[view : view + 1],
        *cameras.size(view),
    )
    return resize(alone, SIDE)


def encoded(linear: Tensor, exposed: bool = False) -> Image.Image:
    """Linear colours [H, W, 3] on black as a picture; exposed: scaled so that they are bright."""
    if exposed:
        luminance = linear.mean(-1)
        linear = linear * (BRIGHT**2.2 / luminance[luminance > 0].quantile(0.99))
    values = (255 * linear_to_srgb(linear.clamp(0, 1))).round().byte()
    return Image.fromarray(values.numpy())


@torch.no_grad()
def main(path: Path, out: Path, *maps: Path) -> None:
    """Render and put side by side."""
    run = univoxel.open_run(path)
    photos = photos_of(path)
    camera = one(photos.cameras, VIEW)
    color, alpha = photos.picture(VIEW)
    photograph = encoded(color * alpha[..., None]).resize((SIDE, SIDE), Image.Resampling.LANCZOS)
    layers = render_layers(run.scene, camera, 0)
    pictures = [photograph, encoded(layers.rgb), encoded(layers.albedo, exposed=True)]
    for name in maps:
        relit = relight_images(path, name, camera, samples=256)[0, ..., :3]
        pictures.append(encoded(relit, exposed=True))
    row = Image.new("RGB", (len(pictures) * (SIDE + GAP) - GAP, SIDE), "white")
    for i, picture in enumerate(pictures):
        row.paste(picture, (i * (SIDE + GAP), 0))
    row.save(out / "real.jpg", quality=QUALITY, optimize=True)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
