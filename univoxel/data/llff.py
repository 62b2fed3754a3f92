"""The layout of LLFF, which NeRD publishes its captures in.

poses_bounds.npy            [V, 17]: a row for each photograph, in the order of their names
images/<name>               photographs, or images_<n>/: shrunk by n
view_imgs.txt               names of those that have a row, where some have none
masks/<name>.png            masks, where there are any; for images_<n>/ also masks_<n>/

A row is camera-to-world [3, 4] with the camera axes down, right and backwards, beside it a column
of height, width and focal length, and at the end the nearest and farthest depth, which say nothing
here. Height, width and focal length may be those of larger originals.

Source: Mildenhall et al. 2019 (Local Light Field Fusion), "Using your own poses".
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from univoxel.data.arrays import read_npy
from univoxel.data.base import Photos
from univoxel.data.foreign import listed_split
from univoxel.data.inside import inside
from univoxel.data.lens import Lens, fitted
from univoxel.data.masks import photographs_in
from univoxel.data.shots import Shot, read_shots, upright
from univoxel.data.transforms import pose_of
from univoxel.errors import DataError

FILE = "poses_bounds.npy"
COLUMNS = 17  # 3 x 5 for the camera, and two depths


def is_llff(folder: Path, split: str) -> bool:
    return (folder / FILE).is_file()


def load_llff(
    folder: Path, split: str = "train", downscale: int = 0, masks: bool | Path = True
) -> Photos:
    """Photographs and cameras of one split, as of `listed_split`.

    The world keeps its scale and origin, and is turned so that +Z is up.

    Raises:
        DataError: one line that names the file, what was expected and what came.
    """
    path = folder / FILE
    rows, pictures = _rows(path), _pictures(folder)
    if len(pictures) != len(rows):
        pictures = _placed(folder, pictures)
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
        shots.append(Shot(picture.stem, where, picture, None, pose, lens))
    shots, remarks = upright(shots)
    shots = listed_split(folder, shots, split)
    return read_shots(folder, "LLFF layout", split, shots, downscale, remarks, masks)


def _placed(folder: Path, pictures: list[Path]) -> list[Path]:
    """The photographs that LLFF's script wrote rows for, where it left some out."""
    listed = folder / "view_imgs.txt"
    if not listed.is_file():
        return pictures
    text = inside(listed, str(listed)).read_text(encoding="utf-8", errors="replace")
    names = {Path(line.strip()).stem for line in text.splitlines()}
    return [path for path in pictures if path.stem in names]


def _rows(path: Path) -> np.ndarray:
    rows = read_npy(path)
    if rows.ndim != 2 or rows.shape[1] != COLUMNS:
        raise DataError(f"{path}: expected [V, {COLUMNS}] numbers, got {np.shape(rows)}")
    if rows.dtype.kind not in "fiu" or not len(rows):
        raise DataError(f"{path}: expected [V, {COLUMNS}] numbers, got {len(rows)} of {rows.dtype}")
    return rows.astype(np.float64)


def _pictures(folder: Path) -> list[Path]:
    """The photographs in order of their names, the largest that there are."""
    shrunk = [p for p in folder.glob("images_*") if p.name.removeprefix("images_").isdigit()]
    shrunk.sort(key=lambda p: int(p.name.removeprefix("images_")))
    for place in (folder / "images", *shrunk):
        if pictures := photographs_in(place):
            return pictures
    raise DataError(f"{folder / FILE}: no pictures in {folder / 'images'} or images_2, images_4 ..")


def _lens(size_and_focal: np.ndarray, picture: Path, where: str) -> Lens:
    """The pinhole of a picture that may be smaller than what its row describes."""
    height, width, focal = size_and_focal.tolist()
    if not all(1 <= x < 1e9 for x in (height, width)) or not 0 < focal < 1e9:
        raise DataError(
            f"{where}: expected height, width and focal length above 0, got {height:g}, "
            f"{width:g}, {focal:g}"
        )
    whole = Lens(int(width), int(height), (focal, focal), (width / 2, height / 2))
    return fitted(whole, picture, where)
