"""Draws the pictures of the tutorial "Your first object", in whose folder its commands were run.

    python docs/figures/bird.py FOLDER docs/images

They are bird_photos.jpg, bird_masks.jpg, bird_sunset.webp, and relit.jpg of the guide.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from PIL import Image

import univoxel

MAPS = Path(univoxel.__file__).parent / "example_data/tiny/envmaps"
PHOTOGRAPHS = 1, 12, 21, 34
WIDTH = 480  # pixels of a picture
BACK = (236, 236, 238)


def over(path: Path, width: int = WIDTH) -> Image.Image:
    """A picture over the background."""
    picture = Image.open(path).convert("RGBA")
    plate = Image.new("RGBA", picture.size, (*BACK, 255))
    plate.alpha_composite(picture)
    size = (width, round(picture.height * width / picture.width))
    return plate.convert("RGB").resize(size, Image.Resampling.LANCZOS)


def sheet(rows: list[list[Image.Image]], gap: int = 6) -> Image.Image:
    """Pictures of one size in rows."""
    width, height = rows[0][0].size
    made = Image.new(
        "RGB",
        (len(rows[0]) * (width + gap) - gap, len(rows) * (height + gap) - gap),
        "white",
    )
    for j, row in enumerate(rows):
        for i, picture in enumerate(row):
            made.paste(picture, (i * (width + gap), j * (height + gap)))
    return made


def main(folder: Path, out: Path) -> None:
    names = [f"IMG_{n:04d}" for n in PHOTOGRAPHS]
    photographs = [over(folder / f"bird_photos/{name}.jpg") for name in names]
    sheet([photographs[:2], photographs[2:]]).save(out / "bird_photos.jpg", quality=88)
    cut = {path.stem: path for path in sorted((folder / "bird/cut").rglob("IMG_*.png"))}
    masks = [
        Image.open(cut[name]).getchannel("A").convert("RGB").resize(photographs[0].size)
        for name in names[:3]
    ]
    sheet([photographs[:3], masks]).resize((966, 486), Image.Resampling.LANCZOS).save(
        out / "bird_masks.jpg", quality=88
    )

    frames = [over(path, 560) for path in sorted((folder / "bird/run/relight").glob("*.png"))]
    frames[0].save(
        out / "bird_sunset.webp",
        save_all=True,
        append_images=frames[1:],
        duration=110,
        loop=0,
        quality=75,
        method=6,
    )

    run, sun = folder / "bird/run", folder / "sun"
    command = [sys.executable, "-m", "univoxel.cli", "relight", str(run)]
    command += ["--envmap", str(MAPS / "city.hdr"), "--sun", "60", "40", "3", "3", "--ground"]
    command += ["lowest", "--orbit", "8", "--samples", "64", "--exposure", "0.8", "--resume"]
    subprocess.run([*command, "--out", str(sun)], check=True)
    relit = [folder / f"bird/pictures/{name}/orbit_0001.png" for name in ("city", "sunset")]
    row = [over(path, 360) for path in (*relit, sun / "orbit_0001.png")]
    sheet([row]).save(out / "relit.jpg", quality=88)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
