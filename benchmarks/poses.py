"""Cameras found by `univoxel poses` against the true ones, on a made scene.

    python benchmarks/poses.py [--width 1200] [--views 40] [--only plain mixed]
        [--out benchmarks/results/preparation/poses.json]
    python benchmarks/poses.py --novel [--width 1200] [--views 40]
        [--out benchmarks/results/preparation/poses_novel.json]
    python benchmarks/poses.py --real FOLDER [--out benchmarks/results/preparation/poses_real.json]

A textured object on a patterned floor in a furnished room (tests/textured_room.py). `plain` are
JPEG files without EXIF; `heic` HEIC; `turned` has every third held upright and stored lying, as
EXIF says; `zoom` two zoom settings in EXIF; `mixed` is all of that, with a white picture and a text
file. Rotations and centres are compared after a similarity. Pictures and scenes are kept in --work.

--novel trains a `draft` of the object in `plain` with found and one with true cameras, on the same
pictures and with true masks. Novel views are every eighth photograph, each from its own camera.

--real finds cameras of the photographs in FOLDER/images with the masks in FOLDER/masks, and says
how long it took; what their cameras are nobody knows.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import sys
import time
from pathlib import Path

import numpy as np
import pillow_heif
from made import made
from PIL import Image

import univoxel
from lab.record import result_text
from univoxel.capture.poses import poses
from univoxel.data.colmap import read_images
from univoxel.data.load_images import TEST_EVERY
from univoxel.data.transforms import write_cameras

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "tests"))

import textured_room  # noqa: E402  beside the tests that share it

VARIANTS = ("plain", "heic", "turned", "zoom", "mixed")
ZOOM = 1.3
LONG = 120  # minutes: a busy machine ends no training early
FOCAL_OF_35MM = np.hypot(36, 24) / 1.25  # of pictures of 4:3 whose focal length is their width
MODEL, ORIENTATION, FOCAL, FOCAL_35MM, WIDTH, HEIGHT = (
    *(0x110, 0x112, 0x920A),
    *(0xA405, 0xA002, 0xA003),
)

FOUND = [
    {"name": "photographs"},
    {"name": "placed"},
    {"name": "reprojection", "unit": "pixels", "digits": 2},
    {"name": "centres off at most", "unit": "% of the radius", "digits": 2},
    {"name": "turned at most", "unit": "degrees", "digits": 3},
    {"name": "processor", "unit": "s", "digits": 0},
    {"name": "wall", "unit": "s", "digits": 0},
]
NOVEL = [
    {"name": "photographs"},
    {"name": "cameras"},
    {"name": "novel views", "unit": "dB", "digits": 1},
    {"name": "SSIM", "digits": 3},
]


def view(variant: str, v: int, views: int, width: int) -> textured_room.View:
    """The camera of one photograph."""
    upright = variant in ("turned", "mixed") and v % 3 == 1
    zoomed = variant in ("zoom", "mixed") and v >= 3 * views // 4
    size = (width, width * 3 // 4)[:: -1 if upright else 1]
    return textured_room.orbit(views, *size, focal=ZOOM if zoomed else 1.0)[v]


def photograph(variant: str, folder: Path, views: int, width: int) -> None:
    """Write the photographs of a variant."""
    for v in range(views):
        seen = view(variant, v, views, width)
        path = folder / f"IMG_{v:03d}.jpg"
        if path.exists() or path.with_suffix(".heic").exists():
            continue
        picture, _ = textured_room.photograph(seen)
        exif = Image.Exif()
        if seen.height > seen.width:
            picture = picture.transpose(Image.Transpose.ROTATE_90)
            exif[ORIENTATION] = 6
        if variant in ("zoom", "mixed"):
            exif[MODEL] = "Phone"
            exif.get_ifd(0x8769).update(
                {
                    FOCAL: 5 * seen.focal,
                    FOCAL_35MM: round(FOCAL_OF_35MM * seen.focal),
                    WIDTH: picture.width,
                    HEIGHT: picture.height,
                }
            )
        if variant == "heic" or (variant == "mixed" and v % 4 == 0):
            heif = pillow_heif.from_pillow(picture)
            heif.save(path.with_suffix(".heic"), quality=80, exif=exif.tobytes())
        else:
            picture.save(path, quality=92, exif=exif)
    if variant == "mixed":
        Image.new("RGB", (width, width * 3 // 4), "white").save(folder / "white.jpg")
        (folder / "notes.txt").write_text("no photograph")


def errors(scene: Path, true: list[textured_room.View]) -> tuple[np.ndarray, np.ndarray]:
    """Of centres, shares of the orbit's radius, and of rotations, degrees."""
    found = {int(i.name[4:7]): i.pose for i in read_images(scene / "sparse/0/images.bin")}
    ours = np.stack([found[v] for v in sorted(found)])
    wanted = np.stack([true[v].pose for v in sorted(found)])
    scale, turn, shift = similarity(ours, wanted)
    left = np.einsum("vij,vkj->vik", turn @ ours[:, :, :3], wanted[:, :, :3])
    cosine = (np.trace(left, axis1=1, axis2=2) - 1) / 2
    away = scale * ours[:, :, 3] @ turn.T + shift - wanted[:, :, 3]
    centres = np.linalg.norm(away, axis=1) / textured_room.RADIUS
    return centres, np.degrees(np.arccos(cosine.clip(-1, 1)))


def similarity(ours: np.ndarray, wanted: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, turn [3, 3] and shift [3] that bring our cameras' centres nearest to the true ones.

    Args:
        ours, wanted: camera-to-world [V, 3, 4].
    """
    middle, true_middle = ours[:, :, 3].mean(0), wanted[:, :, 3].mean(0)
    a, b = ours[:, :, 3] - middle, wanted[:, :, 3] - true_middle
    u, s, v = np.linalg.svd(b.T @ a)
    mirror = np.array([1, 1, np.linalg.det(u @ v)])
    turn = u * mirror @ v
    scale = float((s * mirror).sum() / (a**2).sum())
    return scale, turn, true_middle - scale * turn @ middle


def trained(variant: str, photos: Path, scene: Path, views: int, width: int) -> list[list[object]]:
    """Rows of novel views by a draft: with found and with true cameras."""
    cameras = [view(variant, v, views, width) for v in range(views)]
    images = sorted((scene / "images").iterdir())
    masks = []
    (scene / "masks").mkdir(exist_ok=True)
    for image, seen in zip(images, cameras, strict=True):
        path = scene / "masks" / f"{image.name}.png"
        if not path.exists():
            textured_room.photograph(seen)[1].save(path)
        masks.append(Image.open(path))
    true = photos.with_name(f"{photos.name}-true")
    for split, kept in (
        ("train", lambda v: v % TEST_EVERY),
        ("test", lambda v: not v % TEST_EVERY),
    ):
        chosen = [v for v in range(views) if kept(v)]
        (true / split).mkdir(parents=True, exist_ok=True)
        for v in chosen:
            path = true / split / f"{images[v].stem}.png"
            if path.exists():
                continue
            picture = Image.open(images[v]).convert("RGB")
            picture.putalpha(masks[v])
            picture.save(path)
        write_cameras(
            true,
            split,
            textured_room.cameras([cameras[v] for v in chosen]),
            [images[v].stem for v in chosen],
        )
    rows = []
    for name, folder in (("found", scene), ("true", true)):
        out = photos.with_name(f"{photos.name}-{name}-draft")
        shutil.rmtree(out, ignore_errors=True)
        measured = univoxel.train(folder, out, preset="draft", minutes=LONG).evaluate()
        rows.append([variant, name, measured["nvs_psnr"], measured["nvs_ssim"]])
        print(rows[-1], flush=True)
    return rows


def placed(photos: Path, masks: Path, out: Path) -> list[object]:
    """A row of photographs whose true cameras are not known."""
    shutil.rmtree(out, ignore_errors=True)
    wall, used = time.monotonic(), processor_seconds()
    poses(photos, out, masks=masks)
    wall, used = time.monotonic() - wall, processor_seconds() - used
    found, count = len(read_images(out / "sparse/0/images.bin")), len(list(photos.iterdir()))
    error = json.loads((out / "poses.json").read_text(encoding="utf-8"))["error"]
    return [photos.parent.name, f"{found} of {count}", error, None, None, used, wall]


def processor_seconds() -> float:
    """Of this process and those that it waited for."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in used)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--width", type=int, default=1200)
    parser.add_argument("--views", type=int, default=40)
    parser.add_argument("--only", nargs="+", choices=VARIANTS, default=VARIANTS)
    parser.add_argument("--novel", action="store_true", help="train with them")
    parser.add_argument("--real", type=Path, help="a folder of images/ and masks/")
    parser.add_argument("--work", type=Path, default=Path("runs/poses"))
    parser.add_argument("--out", type=Path, default=HERE / "results/preparation/poses.json")
    args = parser.parse_args()
    rows, novel = [], []
    if args.real:
        rows.append(placed(args.real / "images", args.real / "masks", args.work / args.real.name))
        print(rows[-1], flush=True)
    variants = () if args.real else ("plain",) if args.novel else args.only
    for variant in variants:
        folder = args.work / f"{variant}-{args.width}"
        folder.mkdir(parents=True, exist_ok=True)
        photograph(variant, folder, args.views, args.width)
        out = args.work / f"{variant}-{args.width}-scene"
        if args.novel:
            if not out.exists():
                poses(folder, out)
            novel += trained(variant, folder, out, args.views, args.width)
            continue
        shutil.rmtree(out, ignore_errors=True)
        wall, used = time.monotonic(), processor_seconds()
        poses(folder, out)
        wall, used = time.monotonic() - wall, processor_seconds() - used
        true = [view(variant, v, args.views, args.width) for v in range(args.views)]
        centres, degrees = errors(out, true)
        report = json.loads((out / "poses.json").read_text(encoding="utf-8"))
        rows.append(
            [
                *(variant, f"{len(centres)} of {args.views}", report["error"]),
                *(100 * float(centres.max()), float(degrees.max()), used, wall),
            ]
        )
        print(rows[-1], flush=True)
    record = {
        "title": f"Cameras of {args.views} photographs, {args.width} pixels wide",
        **made(),
        "load_average": os.getloadavg()[0],
        "columns": FOUND,
        "rows": rows,
    }
    if args.real:
        record["title"] = "Cameras of real photographs, with masks"
    if args.novel:
        title = "A `draft` with found and with true cameras"
        record = {"title": title, **made(), "columns": NOVEL, "rows": novel}
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(result_text(record), encoding="utf-8")


if __name__ == "__main__":
    main()
