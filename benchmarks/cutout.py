"""Masks made by `univoxel cutout` against the true ones, of objects painted into rooms.

    python benchmarks/cutout.py DATA [--from rembg none] [--only desk] [--views 40]
        [--out benchmarks/results/preparation/cutout.json]

DATA holds the scenes sneaker, tea_table and chrome_bottle. `near room` is the sneaker in the middle
of a blurred ball, `street` the tea table in a sharp photograph of a street far away, `desk` the
sneaker on a plain desk with a soft shadow, before plain walls of a room, photographed from above
and from the side; `patterned desk` the same on a desk with a pattern, and `patterned room` an
object whose pattern is that of floor and walls (tests/textured_room.py). The photographs are kept
in --work.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from made import made
from scipy import ndimage
from torch import Tensor
from torch.nn.functional import normalize

from lab.record import result_text
from univoxel.camera import Cameras, Rays, image_rays
from univoxel.capture.cutout import DEPTH, REMBG, cutout
from univoxel.color import linear_to_srgb
from univoxel.data import load_photos
from univoxel.data.images import read_image, write_png
from univoxel.data.transforms import write_cameras
from univoxel.envmap import EnvMap, lookup

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "tests"))

import textured_room  # noqa: E402  beside the tests that share it

ROOMS = {
    "near room": ("sneaker", "tea_table/envmaps/warehouse.hdr", 6.0),
    "street": ("tea_table", "chrome_bottle/envmaps/city.hdr", 0.5),
    "desk": ("sneaker", "", 0.0),
    "patterned desk": ("sneaker", "", 0.0),
    "patterned room": ("", "", 0.0),
}  # object, what surrounds it, and by how many pixels that is blurred
BRIGHTEST = 3.0  # radiance of a surrounding's pixel, at most
RADIUS = 7.0  # of the near room
TOP, DESK, WALLS = (0.45, 0.40, 0.33), 3.5, 5.0  # colour and half width of the desk, of the room
SIDES = ((0.62, 0.60, 0.57), (0.55, 0.54, 0.52), (0.30, 0.29, 0.28))  # along X, along Y, floor


def surroundings(room: str, data: Path, rays: Rays, floor: float) -> Tensor:
    """Linear colours [N, 3] of what is behind the object."""
    _, path, blur = ROOMS[room]
    if not path:
        return desk(rays, floor, room == "patterned desk")
    radiance = read_image(data / path).clamp(0, BRIGHTEST).numpy()
    blurred = ndimage.gaussian_filter(radiance, (blur, blur, 0), mode="wrap")
    env = EnvMap(torch.from_numpy(np.asarray(blurred)).float())
    if room == "street":
        return lookup(env, rays.direction)
    along = (rays.origin * rays.direction).sum(1)
    away = (along.square() - rays.origin.square().sum(1) + RADIUS**2).sqrt() - along
    return lookup(env, normalize(rays.origin + away[:, None] * rays.direction, dim=1))


def desk(rays: Rays, height: float, patterned: bool) -> Tensor:
    """A desk with the object's soft shadow, and the walls of a room, each of another grey."""
    away = (height - rays.origin[:, 2]) / rays.direction[:, 2]
    place = (rays.origin + away[:, None] * rays.direction)[:, :2]
    met = (away > 0) & (place.abs().amax(1) < DESK)
    shadow = torch.exp(-(place / torch.tensor([0.8, 0.45])).square().sum(1))
    top = torch.tensor(TOP) * (1 - 0.6 * shadow[:, None])
    if patterned:
        flat = torch.cat([place, torch.zeros(len(place), 1)], 1).T.clamp(-DESK, DESK)
        top *= 0.4 + 1.2 * torch.from_numpy(textured_room.noise(flat.numpy())).float()
    axis = ((torch.sign(rays.direction) * WALLS - rays.origin) / rays.direction).argmin(1)
    far = (rays.direction.gather(1, axis[:, None]) > 0).float()
    return torch.where(met[:, None], top, torch.tensor(SIDES)[axis] * (0.9 + 0.1 * far))


def paint(room: str, data: Path, folder: Path, views: int) -> tuple[list[str], list[Tensor]]:
    """Write a room's photographs, without alpha; return their names and true masks."""
    if room == "patterned room":
        return photograph(folder, views)
    photos = load_photos(data / ROOMS[room][0])
    floor = float(np.load(data / ROOMS[room][0] / "points.npz")["points"][:, 2].min())
    chosen = list(range(0, len(photos), max(1, len(photos) // views)))
    if room.endswith("desk"):  # nobody photographs it from below the desk
        height = photos.cameras.camera_to_world[:, 2, 3]
        chosen = [v for v in range(len(photos)) if height[v] > floor + 0.5][:views]
    names = [photos.names[view] for view in chosen]
    if not folder.exists():
        (folder / "train").mkdir(parents=True)
        for view in chosen:
            color, alpha = photos.picture(view)
            rays = image_rays(photos.cameras, view)
            behind = surroundings(room, data, rays, floor).reshape(color.shape)
            seen = torch.lerp(behind, color, alpha[..., None]).clamp(0, 1)
            encoded = (255 * linear_to_srgb(seen)).round().byte()
            write_png(folder / "train" / f"{photos.names[view]}.png", encoded)
        write_cameras(folder, "train", some(photos.cameras, chosen), names)
    return names, [photos.picture(view)[1] for view in chosen]


def photograph(folder: Path, views: int) -> tuple[list[str], list[Tensor]]:
    """Photographs of the patterned room: their names and true masks."""
    seen = textured_room.orbit(views, 400, 300)
    names, masks = [f"{v:03d}" for v in range(views)], []
    (folder / "train").mkdir(parents=True, exist_ok=True)
    for name, view in zip(names, seen, strict=True):
        picture, mask = textured_room.photograph(view)
        picture.save(folder / "train" / f"{name}.png")
        masks.append(torch.from_numpy(np.array(mask)).float() / 255)
    write_cameras(folder, "train", textured_room.cameras(seen), names)
    return names, masks


def some(cameras: Cameras, views: list[int]) -> Cameras:
    """Those of these views."""
    return replace(
        cameras,
        camera_to_world=cameras.camera_to_world[views],
        focal=cameras.focal[views],
        centre=cameras.centre[views],
    )


def overlap(found: Tensor, true: Tensor) -> float:
    """Intersection over union of two masks [H, W]."""
    found, true = found >= 0.5, true >= 0.5
    return float((found & true).sum() / (found | true).sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--from", dest="sources", nargs="+", default=[REMBG])
    parser.add_argument("--only", nargs="+", choices=list(ROOMS), default=list(ROOMS))
    parser.add_argument("--views", type=int, default=40)
    parser.add_argument("--work", type=Path, default=Path("runs/cutout"))
    parser.add_argument("--out", type=Path, default=HERE / "results/preparation/cutout.json")
    args = parser.parse_args()
    rows = []
    for room in args.only:
        folder = args.work / room.replace(" ", "-")
        names, true = paint(room, args.data, folder, args.views)
        for source in args.sources:
            out = args.work / f"{folder.name}-{source}"
            shutil.rmtree(out, ignore_errors=True)
            used = time.process_time()
            cutout(folder, out, source)
            used = time.process_time() - used
            masks = load_photos(out)
            found = [
                overlap(masks.picture(masks.names.index(name))[1], mask)
                for name, mask in zip(names, true, strict=True)
            ]
            label = {REMBG: "a network", DEPTH: "depth alone"}.get(source, source)
            rows.append([room, label, sum(found) / len(found), min(found), used])
            print(rows[-1], flush=True)
    record = {
        "title": "Masks made by `cutout`: overlap with the true ones",
        **made(),
        "note": f"{args.views} photographs of 400 x 400 pixels, painted into rooms.",
        "columns": [
            {"name": "object"},
            {"name": "masks from"},
            {"name": "mean IoU", "digits": 3},
            {"name": "worst photograph IoU", "digits": 3},
            {"name": "processor", "unit": "s", "digits": 0},
        ],
        "rows": rows,
    }
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(result_text(record), encoding="utf-8")


if __name__ == "__main__":
    main()
