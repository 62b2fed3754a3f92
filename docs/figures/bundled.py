"""Draws the pictures of the documentation that show the bundled scene.

    univoxel train univoxel/example_data/tiny --out RUN --preset fast --minutes 4 \\
        --set stages.0.voxels=0.27 --set stages.1.voxels=0.6 --set stages.3.voxels=0.6 \\
        --timelapse RUN/film/
    python docs/figures/bundled.py RUN docs/images

A timelapse has a frame for each sixtieth of the minutes, and each stage needs one near its end.
Commands of univoxel make the pictures. This script puts them side by side.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from univoxel.data.images import read_exr
from univoxel.evaluation.confidence import ALBEDO_LIMIT

SCENE = Path(__file__).parents[2] / "univoxel/example_data/tiny"
VIEW = 2  # of the test views: pepper and avocado side by side
SIDE = 220  # pixels of a picture
FRAME = 120  # pixels of one in a timelapse
GAP = 6  # between pictures
LABEL = 18  # pixels above a frame of a timelapse, and above a picture of `univoxel inspect`


def univoxel(*arguments: str) -> None:
    subprocess.run([sys.executable, "-m", "univoxel.cli", *arguments], check=True)


def beside(pictures: list[Image.Image], background: str = "white") -> Image.Image:
    """Pictures of one height in a row."""
    width = sum(p.width for p in pictures) + GAP * (len(pictures) - 1)
    row, x = Image.new("RGB", (width, pictures[0].height), background), 0
    for picture in pictures:
        row.paste(picture.convert("RGB"), (x, 0))
        x += picture.width + GAP
    return row


def below(pictures: list[Image.Image], background: str = "white") -> Image.Image:
    """Pictures of one width, one below another."""
    turned = [p.convert("RGB").transpose(Image.Transpose.TRANSPOSE) for p in pictures]
    return beside(turned, background).transpose(Image.Transpose.TRANSPOSE)


def square(picture: Image.Image) -> Image.Image:
    return picture.resize((SIDE, SIDE), Image.Resampling.LANCZOS)


def opened(path: Path, background: str = "black") -> Image.Image:
    """A picture over a colour."""
    picture = Image.open(path).convert("RGBA")
    plate = Image.new("RGBA", picture.size, background)
    return Image.alpha_composite(plate, picture).convert("RGB")


def from_values(values: np.ndarray, most: float = 1.0) -> Image.Image:
    """Values [H, W] from 0, black, to `most`, white."""
    scaled = np.clip(values / most, 0, 1)
    return square(Image.fromarray((255 * scaled).round().astype(np.uint8)))


def encoded(linear: np.ndarray) -> np.ndarray:
    """sRGB of linear colours."""
    x = np.clip(linear, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def from_color(linear: np.ndarray) -> Image.Image:
    return square(Image.fromarray((255 * encoded(linear)).round().astype(np.uint8)))


def stage_frames(run: Path, out: Path) -> None:
    """Render, albedo and normals as each stage ends."""
    stages = json.loads((run / "config.json").read_text())["stages"]
    film = {int(path.stem.removeprefix("step_")): path for path in (run / "film").glob("*.png")}
    columns, end = [], 0
    for stage in stages:
        end += stage["iterations"]
        frame = Image.open(film[max(step for step in film if step <= end)]).convert("RGB")
        side = frame.width // 3
        left, top = side // 8, LABEL + side // 8  # of what is not just black
        parts = [
            frame.crop((k * side + left, top, (k + 1) * side - left, LABEL + side - side // 8))
            for k in range(3)
        ]
        size = (FRAME, FRAME)
        columns.append(below([part.resize(size, Image.Resampling.LANCZOS) for part in parts]))
    beside(columns).save(out / "stage_frames.png", optimize=True)


def expected_error(test: Path, out: Path) -> None:
    """Render, albedo, expected error of the albedo and its true error, in one view."""
    layers = read_exr(test / f"r_{VIEW:03d}.exr")
    albedo = np.stack([layers[f"albedo.{c}"] for c in "RGB"], -1)
    render = np.stack([layers[f"rgb.{c}"] for c in "RGB"], -1)
    truth = np.load(SCENE / f"test/gt/r_{VIEW:03d}.npz")
    inside = truth["alpha"] > 127
    scale = np.median(truth["albedo"][inside] / albedo[inside].clip(1e-3), 0)
    error = np.abs(encoded(albedo * scale) - encoded(truth["albedo"])).mean(-1) * inside
    told = from_values(layers["expected_error.albedo"] * inside, ALBEDO_LIMIT)
    pictures = [from_color(render), from_color(albedo), told, from_values(error, ALBEDO_LIMIT)]
    beside(pictures).save(out / "expected_error.png", optimize=True)


def point_light(run: Path, work: Path, out: Path) -> None:
    """The view and its point; the local light there, the map with what blocks it, the truth."""
    path = work / "point.png"
    at = "--view", "0", "--pixel", "50,50"
    univoxel("inspect", str(run), *at, "--out", str(path))
    whole = Image.open(path).convert("RGB")
    height = whole.height // 3  # of a label and a picture
    left = whole.crop((0, LABEL, 256, LABEL + 256))
    right = [
        whole.crop((whole.width - 256, k * height + LABEL, whole.width, (k + 1) * height))
        for k in range(3)
    ]
    view = left.resize((right[0].height, right[0].height), Image.Resampling.LANCZOS)
    beside([view, *right]).save(out / "point_light.png", optimize=True)


def main() -> None:
    run, out = map(Path, sys.argv[1:])
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        stage_frames(run, out)
        univoxel("envmap", str(run), "--out", str(work / "light.exr"))
        Image.open(work / "light.png").save(out / "envmap.png", optimize=True)
        univoxel("eval", str(run), "--save", str(work / "test"))
        expected_error(work / "test", out)
        point_light(run, work, out)


if __name__ == "__main__":
    main()
