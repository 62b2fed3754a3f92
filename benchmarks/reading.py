"""What large photographs cost: time and memory to read, to read again, and to train.

    python benchmarks/reading.py FOLDER [--count 100] [--megapixels 12] [--lens 0.05]
        [--preset fast] [--minutes 1] [--out benchmarks/results/reading.json]

The bundled scene's photographs are enlarged to so many pixels and written as JPEG, with grain as of
a camera, and with masks beside them; FOLDER keeps them for the next time. Each row is a process of
its own; memory is the most that it held, the imports included. Photographs are as the system has
them in its memory, or not: it is not emptied before.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from multiprocessing import Pool
from pathlib import Path

import numpy as np
from made import made
from PIL import Image

from lab.record import result_text
from univoxel.data import keep_photos, load_photos

HERE = Path(__file__).parent
DATA = HERE.parent / "univoxel" / "example_data" / "tiny"
GRAIN = 3.0  # bytes, standard deviation
QUALITY = 92  # of the JPEG files
COLUMNS = [
    {"name": "step"},
    {"name": "wall", "unit": "s", "digits": 1},
    {"name": "processor", "unit": "s", "digits": 1},
    {"name": "memory", "unit": "GB", "digits": 2},
]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--megapixels", type=float, default=12.0)
    parser.add_argument("--lens", type=float, default=0.0, help="k1 of the lens")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--step", choices=STEPS, help="one alone, in this process")
    args = parser.parse_args()
    kept = args.folder / "kept.safetensors"
    if args.step:
        print(json.dumps(STEPS[args.step](args, kept)))
        return
    side = round((1e6 * args.megapixels) ** 0.5)
    write(args.folder, args.count, side, args.lens)
    kept.unlink(missing_ok=True)
    rows = []
    for step in STEPS:
        command = [sys.executable, __file__, *sys.argv[1:], "--step", step]
        told = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout
        rows.append({"step": step, **json.loads(told.splitlines()[-1])})
        print(rows[-1])
    result = made() | {
        "title": f"{args.count} photographs of {side}x{side} pixels",
        "columns": COLUMNS,
        "rows": [list(row.values()) for row in rows],
    }
    if args.out:
        args.out.write_text(result_text(result))


def read(args: argparse.Namespace, kept: Path) -> dict[str, float]:
    """Read the photographs and keep them; or read what was kept."""
    begin = time.perf_counter()
    photos = load_photos(args.folder, kept=kept)
    keep_photos(photos, kept)
    return costs(time.perf_counter() - begin)


def train(args: argparse.Namespace, kept: Path) -> dict[str, float]:
    """Train for so long, from photographs that were not kept."""
    from univoxel.cli.trainer import train as task
    from univoxel.presets import chosen

    begin = time.perf_counter()
    task(chosen(args.preset, args.minutes, args.folder, args.folder / "run"))
    return costs(time.perf_counter() - begin)


STEPS = {"read": read, "read again": read, "train": train}


def costs(seconds: float) -> dict[str, float]:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return {
        "wall": seconds,
        "processor": usage.ru_utime + usage.ru_stime,
        "memory": usage.ru_maxrss * 1024 / 1e9,
    }


def write(folder: Path, count: int, side: int, k1: float) -> None:
    """The enlarged scene in the layout of nerfstudio, unless it is there already."""
    wanted = {"count": count, "side": side, "k1": k1}
    said = folder / "made.json"
    if said.is_file() and json.loads(said.read_text()) == wanted:
        return
    for name in ("images", "masks"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    root = json.loads((DATA / "transforms_train.json").read_text())
    focal = 0.5 * side / np.tan(0.5 * root["camera_angle_x"])
    frames, jobs = [], []
    for k in range(count):
        frame = root["frames"][k % len(root["frames"])]
        name = f"p_{k:03d}"
        jobs.append((DATA / f"{frame['file_path']}.png", folder, name, side, k))
        files = {"file_path": f"images/{name}.jpg", "mask_path": f"masks/{name}.png"}
        frames.append(files | {"transform_matrix": frame["transform_matrix"]})
    with Pool() as pool:
        pool.starmap(enlarge, jobs)
    camera = {"fl_x": focal, "w": side, "h": side, "k1": k1}
    names = [frame["file_path"] for frame in frames]
    splits = {"train_filenames": names, "test_filenames": names[:8]}
    text = json.dumps(camera | splits | {"frames": frames})
    (folder / "transforms.json").write_text(text)
    said.write_text(json.dumps(wanted))


def enlarge(source: Path, folder: Path, name: str, side: int, seed: int) -> None:
    with Image.open(source) as image:
        large = image.convert("RGBA").resize((side, side), Image.Resampling.BICUBIC)
    pixels = np.asarray(large)
    grain = np.random.default_rng(seed).normal(0, GRAIN, pixels.shape[:2]).astype(np.float32)
    color = (pixels[..., :3] + grain[..., None]).clip(0, 255).astype(np.uint8)
    Image.fromarray(color).save(folder / "images" / f"{name}.jpg", quality=QUALITY)
    Image.fromarray(pixels[..., 3]).save(folder / "masks" / f"{name}.png", compress_level=6)


if __name__ == "__main__":
    main()
