"""The layout of IDR, NeuS and DTU, and of BlendedMVS as NeuS has it.

cameras_sphere.npz      world_mat_0, world_mat_1, ..: [4, 4] or [3, 4] from the world to pixels,
                        K [R t]; or cameras.npz, cameras_large.npz. scale_mat_i and camera_mat_i
                        say nothing here
image/000.png           photographs: number i, or the i-th in order of their names
mask/000.png            masks: of the same name, number or place

Source: Yariv et al. 2020 (IDR) and Wang et al. 2021 (NeuS), the conventions of their data.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.linalg import rq

from univoxel.data.arrays import read_npz
from univoxel.data.base import Photos
from univoxel.data.foreign import TO_OPENGL, check_skew
from univoxel.data.images import image_size, turn_note
from univoxel.data.masks import find_masks, photographs_in
from univoxel.data.missing import left_out
from univoxel.data.shots import Shot, every_eighth, read_shots, upright
from univoxel.data.transforms import lens_of, pose_of
from univoxel.errors import DataError

FILES = ("cameras_sphere.npz", "cameras.npz", "cameras_large.npz")
PREFIX = "world_mat_"
KEY = re.compile(r"world_mat_[0-9]{1,9}")
IMAGES = ("image", "images", "rgb")
MASKS = ("mask", "masks")


def is_idr(folder: Path, split: str) -> bool:
    return _file(folder) is not None


def load_idr(
    folder: Path, split: str = "train", downscale: int = 0, masks: bool | Path = True
) -> Photos:
    """Photographs and cameras of one split: every eighth is for tests.

    The world is that of world_mat: it keeps its scale and origin, and is turned so that +Z is up.

    Raises:
        DataError: one line that names the file, what was expected and what came.
    """
    path = _file(folder) or folder / FILES[0]
    matrices, pictures = _matrices(path), _pictures(folder, path)
    numbers = _numbers(path, sorted(matrices), pictures)
    missing = [f"number {number}" for number in sorted(matrices) if number not in numbers]
    lost = left_out(str(path), missing, len(matrices), f" (looked in {pictures[0].parent})")
    shots, silhouettes = [], _masks(folder, pictures)
    for number, picture, mask in zip(numbers, pictures, silhouettes, strict=True):
        where = f"{path}: world_mat_{number}"
        intrinsics, pose = decomposed(matrices[number], where)
        size = image_size(picture)
        (fx, skew, cx), (_, fy, cy), _ = intrinsics.tolist()
        values = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
        lens = lens_of(values, where, *size, turn_note(picture))
        check_skew(skew, lens, where)
        shots.append(Shot(picture.stem, where, picture, mask, pose, lens))
    shots, remarks = upright(shots)
    shots = every_eighth(folder, shots, split)
    kind = f"IDR layout ({path.name})"
    return read_shots(folder, kind, split, shots, downscale, [*lost, *remarks], masks)


def decomposed(matrix: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics K [3, 3] and camera-to-world [3, 4] of a projection K [R t].

    Args:
        matrix: [3, 4], of any scale and sign.

    Returns:
        K with 1 at its end, and the pose, its axes as of `Cameras`.
    """
    matrix = matrix * (1 if np.linalg.det(matrix[:, :3]) > 0 else -1)
    if not np.linalg.cond(matrix[:, :3]) < 1e12:
        raise DataError(f"{where}: expected a projection onto a picture, got a singular matrix")
    upper, rotation = rq(matrix[:, :3])
    signs = np.sign(np.diag(upper))  # focal lengths are positive; that they are so is all there is
    upper, rotation = upper * signs, signs[:, None] * rotation
    position = -np.linalg.solve(matrix[:, :3], matrix[:, 3])
    pose = pose_of(np.column_stack([rotation.T @ TO_OPENGL, position]), where)
    return upper / upper[2, 2], pose


def _file(folder: Path) -> Path | None:
    return next((path for name in FILES if (path := folder / name).is_file()), None)


def _matrices(path: Path) -> dict[int, np.ndarray]:
    """[3, 4] from the world to pixels, by number."""
    arrays = read_npz(path, PREFIX)
    found = {int(key.removeprefix(PREFIX)): a for key, a in arrays.items() if KEY.fullmatch(key)}
    if not found:
        raise DataError(f"{path}: expected arrays world_mat_0, world_mat_1 .., got none")
    for number, matrix in found.items():
        if matrix.shape not in ((4, 4), (3, 4)) or matrix.dtype.kind not in "fiu":
            raise DataError(
                f"{path}: expected world_mat_{number} [4, 4] of numbers, got "
                f"{list(matrix.shape)} of {matrix.dtype}"
            )
        if not np.isfinite(matrix).all():
            raise DataError(f"{path}: world_mat_{number} holds NaN or infinity")
    return {number: matrix[:3].astype(np.float64) for number, matrix in found.items()}


def _pictures(folder: Path, path: Path) -> list[Path]:
    """Photographs in order of their names, or of their numbers."""
    for name in IMAGES:
        if found := photographs_in(folder / name):
            return _ordered(found)
    raise DataError(f"{path}: no pictures in {folder / IMAGES[0]}")


def _ordered(pictures: list[Path]) -> list[Path]:
    """9.png before 10.png, where all names are numbers."""
    if all(path.stem.isdecimal() for path in pictures):
        return sorted(pictures, key=lambda path: int(path.stem))
    return pictures


def _numbers(path: Path, known: list[int], pictures: list[Path]) -> list[int]:
    """The number of each picture's matrix."""
    if len(pictures) == len(known):
        return known
    found = [int(p.stem) if p.stem.isdecimal() else -1 for p in pictures]
    if set(found) <= set(known) and len(set(found)) == len(found):
        return found
    raise DataError(
        f"{path}: expected a world_mat for each of {len(pictures)} photographs in "
        f"{pictures[0].parent}, got {len(known)}, and names that are not their numbers"
    )


def _masks(folder: Path, pictures: list[Path]) -> Sequence[Path | None]:
    """The masks of photographs: by their places where no name tells."""
    if any(find_masks(folder, [(path.stem, path) for path in pictures])):
        return [None] * len(pictures)  # `read_shots` finds them again
    listed = next((found for name in MASKS if (found := photographs_in(folder / name))), [])
    listed = _ordered(listed)
    return listed if len(listed) == len(pictures) else [None] * len(pictures)
