"""Draws docs/images/real.jpg: a photograph, and its model.

    univoxel poses ethiopian_head/images --masks ethiopian_head/masks --out HEAD
    univoxel train HEAD --out RUN --preset fast
    python docs/figures/model.py RUN docs/images/real.jpg forest_slope.hdr sunset.hdr

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
from univoxel.cli.relight import relight_images
from univoxel.color import linear_to_srgb
from univoxel.evaluation.measures import Layers, render_layers
from univoxel.run import photos_of

VIEW = 0  # of the test views
LAYERS = "albedo", "roughness", "normal"
LONGER, GAP = 300, 4  # pixels of a picture's longer side, and between two
MARGIN = 0.03  # of the object's longer side, around it
BRIGHT = 0.7  # sRGB of the picture's brightest hundredth; a light of other strength is scaled
QUALITY = 85  # of a JPEG, which stays below 200 kB


def box_around(alpha: Tensor) -> tuple[int, int, int, int]:
    """What is opaque in a photograph's alpha [H, W], and the margin, for `Image.crop`."""
    left, top, right, bottom = encoded((alpha > 0.5).float()).getbbox()
    margin = round(MARGIN * max(right - left, bottom - top))
    return left - margin, top - margin, right + margin, bottom + margin


def picture(linear: Tensor, exposed: bool = False) -> Image.Image:
    """Linear colours [H, W, 3] on black as a picture; exposed: scaled so that they are bright."""
    if exposed:
        luminance = linear.mean(-1)
        linear = linear * (BRIGHT**2.2 / luminance[luminance > 0].quantile(0.99))
    return encoded(linear_to_srgb(linear.clamp(0, 1)))


def encoded(values: Tensor) -> Image.Image:
    """Values [H, W] or [H, W, 3] in [0, 1] as a picture."""
    return Image.fromarray((255 * values).round().byte().numpy())


def layer(layers: Layers, name: str) -> Image.Image:
    """One of a view's LAYERS: roughness from black, 0, to white, 1; normals of the world."""
    if name == "albedo":
        return picture(layers.albedo, exposed=True)
    if name == "roughness":
        return encoded(layers.roughness.clamp(0, 1))
    return encoded((0.5 + 0.5 * layers.normal).clamp(0, 1) * layers.alpha[..., None])


@torch.no_grad()
def main(path: Path, out: Path, maps: list[Path], names: list[str]) -> None:
    """Render and put side by side."""
    run = univoxel.open_run(path)
    photos = photos_of(path)
    color, alpha = photos.picture(VIEW)
    camera = photos.cameras.of(torch.tensor([VIEW]))
    layers = render_layers(run.scene, camera, 0)
    pictures = [picture(color * alpha[..., None]), picture(layers.rgb)]
    pictures += [layer(layers, name) for name in names]
    for name in maps:
        relit = relight_images(path, name, camera, samples=256)[0, ..., :3]
        pictures.append(picture(relit, exposed=True))
    box = left, top, right, bottom = box_around(alpha)
    scale = LONGER / max(right - left, bottom - top)
    size = round(scale * (right - left)), round(scale * (bottom - top))
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
    parser.add_argument("--layers", nargs="+", choices=LAYERS, default=["albedo"], help="of it")
    given = parser.parse_args()
    main(given.run, given.out, given.maps, given.layers)
