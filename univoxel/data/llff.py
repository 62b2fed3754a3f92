"""The layout of LLFF, which NeRD publishes its captures in.

poses_bounds.npy            [V, 17]: a row for each photograph, in the order of their names
images/<name>               photographs, or images_<n>/: shrunk by n
masks/<name>.png            masks, where there are any; masks_<n>/ for images_<n>/

A row is camera-to-world [3, 4] with the camera axes down, right and backwards, beside it a column
of height, width and focal length, and at the end the nearest and farthest depth, which say nothing
here. Height, width and focal length may be those of larger originals.

Source: Mildenhall et al. 2019 (Local Light Field Fusion), "Using your own poses".
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from univoxel.data.base import Photos
from univoxel.data.images import SUFFIXES, image_size, turn_note
from univoxel.data.lens import Lens
from univoxel.data.shots import Shot, every_eighth, find_mask, read_shots, upright
from univoxel.data.transforms import pose_of
from univoxel.errors import DataError

FILE = "poses_bounds.npy"
COLUMNS = 17  # 3 x 5 for the camera, and two depths
TALLER = 0.01  # share by which a shrunk picture may be taller or wider than its original


def is_llff(folder: Path, split: str) -> bool:
    return (folder / FILE).is_file()


def load_llff(folder: Path, split: str = "train", downscale: int = 0, masks: bool = True) -> Photos:
    """Photographs and cameras of one split: every eighth is for tests.

    The world keeps its scale and origin, and is turned so that +Z is up.

    Raises:
        DataError: one line that names the file, what was expected and what came.
    """
    path = folder / FILE
    rows, (pictures, ending) = _rows(path), _pictures(folder)
    if len(pictures) != len(rows):
        raise DataError(
            f"{path}: expected a row for each of {len(pictures)} photographs in "
            f"{pictures[0].parent}, got {len(rows)}"
        )
    shots = []
    for number, (row, picture) in enumerate(zip(rows, pictures, strict=True)):
        where = f"{path}: row {number}"
        camera = row[:15].reshape(3, 5)
        down, right, back, position = camera[:, :4].T
        pose = pose_of(np.stack([right, -down, back, position], 1), where)
        lens = _lens(camera[:, 4], picture, where)
        mask = find_mask(folder, picture.name, f"masks{ending}")
        shots.append(Shot(picture.stem, where, picture, mask, pose, lens))
    shots, remarks = upright(shots)
    shots = every_eighth(folder, shots, split)
    return read_shots(folder, "LLFF layout", split, shots, downscale, remarks, masks)


def _rows(path: Path) -> np.ndarray:
    try:
        rows = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise DataError(f"{path}: expected an array of NumPy, could not read it: {error}") from None
    if not isinstance(rows, np.ndarray) or rows.ndim != 2 or rows.shape[1] != COLUMNS:
        raise DataError(f"{path}: expected [V, {COLUMNS}] numbers, got {np.shape(rows)}")
    if rows.dtype.kind not in "fiu" or not len(rows):
        raise DataError(f"{path}: expected [V, {COLUMNS}] numbers, got {len(rows)} of {rows.dtype}")
    return rows.astype(np.float64)


def _pictures(folder: Path) -> tuple[list[Path], str]:
    """The photographs in order of their names, the largest that there are; and what stands behind
    `images` in the name of their folder."""
    shrunk = [p for p in folder.glob("images_*") if p.name.removeprefix("images_").isdigit()]
    shrunk.sort(key=lambda p: int(p.name.removeprefix("images_")))
    for place in (folder / "images", *shrunk):
        found = place.iterdir() if place.is_dir() else []
        pictures = sorted(p for p in found if p.suffix.lower() in SUFFIXES)
        if pictures:
            return pictures, place.name.removeprefix("images")
    raise DataError(f"{folder / FILE}: no pictures in {folder / 'images'} or images_2, images_4 ..")


def _lens(size_and_focal: np.ndarray, picture: Path, where: str) -> Lens:
    """The pinhole of a picture that may be smaller than what its row describes."""
    height, width, focal = size_and_focal.tolist()
    if not all(0 < x < 1e9 for x in (height, width, focal)):
        raise DataError(
            f"{where}: expected height, width and focal length above 0, got {height:g}, "
            f"{width:g}, {focal:g}"
        )
    w, h = image_size(picture)
    across, down = w / width, h / height
    if abs(across / down - 1) > TALLER + 1 / min(w, h):
        raise DataError(
            f"{picture}: expected a picture of the shape {width:g}x{height:g} as in {where}, got "
            f"{w}x{h}{turn_note(picture)}"
        )
    return Lens(w, h, (focal * across, focal * down), (w / 2, h / 2))
