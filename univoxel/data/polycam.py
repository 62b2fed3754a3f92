"""Polycam's raw data, as its developer mode exports them.

keyframes/corrected_cameras/<time>.json     fx, fy, cx, cy, width, height, and t_00 to t_23:
                                            camera-to-world, axes as of ARKit; or keyframes/cameras
keyframes/corrected_images/<time>.jpg       photographs; or keyframes/images
keyframes/masks/<time>.png                  masks, which Polycam does not make; or masks

ARKit's camera axes are x right, y up, z backwards, of the picture as it is stored, and its world
has +Y up.

Source: nerfstudio's documentation of its converter for Polycam; Apple's of ARCamera.transform.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from univoxel.data.base import Photos
from univoxel.data.inside import inside
from univoxel.data.lens import fitted
from univoxel.data.missing import left_out
from univoxel.data.shots import Shot, every_eighth, read_shots
from univoxel.data.transforms import lens_of, listed_image, number, pose_of, short
from univoxel.errors import DataError
from univoxel.files import read_json

# Where cameras and images are; what loops were closed in comes first
PLACES = ("keyframes/corrected_", "keyframes/", "corrected_")
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # from +Y up to +Z up


def is_polycam(folder: Path, split: str) -> bool:
    return _place(folder) is not None


def load_polycam(
    folder: Path, split: str = "train", downscale: int = 0, masks: bool | Path = True
) -> Photos:
    """Photographs and cameras of one split: every eighth is for tests.

    The world keeps its scale, metres, and its origin, and is turned from +Y up to +Z up.

    Raises:
        DataError: one line that names the file, what was expected and what came.
    """
    place = _place(folder) or PLACES[0]
    cameras, pictures = (
        sorted((folder / f"{place}cameras").glob("*.json")),
        folder / f"{place}images",
    )
    shots, missing = [], []
    for path in cameras:
        picture = listed_image(pictures, path.stem, str(path))
        if picture is None:
            missing.append(path.stem)
            continue
        values = _read(path)
        width, height = (int(values[key]) for key in ("width", "height"))
        lens = fitted(lens_of(values, str(path), width, height), picture, str(path))
        pose = UPRIGHT @ pose_of(values["pose"], str(path))
        shots.append(Shot(path.stem, str(path), picture, None, pose, lens))
    note = f" (looked in {pictures}"
    others = folder / f"{place.removesuffix('corrected_')}images"
    if others != pictures and others.is_dir():
        note += f"; those in {others} are of the cameras in {others.with_name('cameras')}"
    lost = left_out(str(cameras[0].parent), missing, len(cameras), f"{note})")
    shots = every_eighth(folder, shots, split)
    remarks = [*lost, "world turned from +Y to +Z up"]
    return read_shots(folder, "Polycam raw data", split, shots, downscale, remarks, masks)


def _place(folder: Path) -> str | None:
    for place in PLACES:
        if any((folder / f"{place}cameras").glob("*.json")):
            return place
    return None


def _read(path: Path) -> dict:
    """Intrinsics in the words of `lens_of`, width, height and the pose [3, 4]."""
    root = read_json(inside(path, str(path)))
    if not isinstance(root, dict):
        raise DataError(f"{path}: expected a JSON object, got {short(root)}")
    found = {key: number(root, key, str(path), 0, math.inf) for key in ("width", "height")}
    keys = {"fx": "fl_x", "fy": "fl_y", "cx": "cx", "cy": "cy"}
    found |= {to: number(root, key, str(path), -math.inf, math.inf) for key, to in keys.items()}
    rows = [[f"t_{row}{column}" for column in range(4)] for row in range(3)]
    pose = [[number(root, key, str(path), -math.inf, math.inf) for key in row] for row in rows]
    return {**found, "pose": pose}
