"""Layouts of published research data sets: LLFF, IDR, NeILF, TensoIR.

docs/reference/data-sets.md lists the files of each.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path, PureWindowsPath

import numpy as np
from scipy.linalg import rq

from univoxel.core.files import read_json
from univoxel.data.images import image_size, turn_note
from univoxel.data.lens import Lens, fitted
from univoxel.data.load_images import Listed, Shot, listed_split, present, turned_up
from univoxel.data.masks import find_masks, photographs_in
from univoxel.data.path_sandbox import inside, left_out, read_npy, read_npz
from univoxel.data.transforms import (
    TO_OPENGL,
    check_skew,
    lens_of,
    listed_image,
    pose_of,
    read_number,
    short,
)
from univoxel.errors import DataError

# LLFF, in which NeRD publishes its captures.
#
# A row is camera-to-world [3, 4] with the camera axes down, right and backwards, beside it a column
# of height, width and focal length, and at the end the nearest and farthest depth, which say
# nothing here. Height, width and focal length may be those of larger originals.
#
# Source: Mildenhall et al. 2019 (Local Light Field Fusion), "Using your own poses".


COLUMNS = 17  # 3 x 5 for the camera, and two depths


def list_llff(folder: Path, split: str, path: Path) -> Listed:
    rows, pictures = _rows(path), _llff_pictures(folder, path)
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
        lens = _llff_lens(camera[:, 4], picture, where)
        shots.append(Shot(picture.stem, where, picture, None, pose, lens))
    return turned_up(folder, split, "LLFF layout", shots, chosen=listed_split)


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
        raise DataError(f"{path}: expected rows of {COLUMNS} numbers, got shape {np.shape(rows)}")
    if rows.dtype.kind not in "fiu" or not len(rows):
        raise DataError(f"{path}: expected rows of numbers, got {len(rows)} rows of {rows.dtype}")
    return rows.astype(np.float64)


def _llff_pictures(folder: Path, path: Path) -> list[Path]:
    """The photographs in order of their names, the largest that there are."""
    shrunk = [p for p in folder.glob("images_*") if p.name.removeprefix("images_").isdigit()]
    shrunk.sort(key=lambda p: int(p.name.removeprefix("images_")))
    for place in (folder / "images", *shrunk):
        if pictures := photographs_in(place):
            return pictures
    raise DataError(
        f"{path}: expected images in {folder / 'images'}, images_2, images_4 or similar, found none"
    )


def _llff_lens(size_and_focal: np.ndarray, picture: Path, where: str) -> Lens:
    """The pinhole of a picture that may be smaller than what its row describes."""
    height, width, focal = size_and_focal.tolist()
    if not all(1 <= x < 1e9 for x in (height, width)) or not 0 < focal < 1e9:
        raise DataError(
            f"{where}: expected height, width and focal length above 0, got {height:g}, "
            f"{width:g} and {focal:g}"
        )
    whole = Lens(int(width), int(height), (focal, focal), (width / 2, height / 2))
    return fitted(whole, picture, where)


# IDR, NeuS and DTU, and BlendedMVS as NeuS has it.
#
# world_mat_<i> leads from the world to pixels, K [R t]. Photographs are those of its number, or the
# i-th in order of their names; masks are of the same name, number or place.
#
# Source: Yariv et al. 2020 (IDR) and Wang et al. 2021 (NeuS), the conventions of their data.


PREFIX = "world_mat_"
KEY = re.compile(r"world_mat_[0-9]{1,9}")


def list_idr(folder: Path, split: str, path: Path) -> Listed:
    """The world is that of world_mat."""
    matrices, pictures = _matrices(path), _first_ordered(folder, "image", "images", "rgb")
    if not pictures:
        raise DataError(f"{path}: expected images in {folder / 'image'}, found none")
    numbers = _numbers(path, sorted(matrices), pictures)
    missing = [f"number {number}" for number in sorted(matrices) if number not in numbers]
    lost = left_out(str(path), missing, len(matrices), f" (looked in {pictures[0].parent})")
    shots, silhouettes = [], _masks(folder, pictures)
    for number, picture, mask in zip(numbers, pictures, silhouettes, strict=True):
        where = f"{path}: world_mat_{number}"
        intrinsics, pose = decomposed(matrices[number], where)
        (fx, skew, cx), (_, fy, cy), _ = intrinsics.tolist()
        values = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
        lens = lens_of(values, where, *image_size(picture), turn_note(picture))
        check_skew(skew, lens, where)
        shots.append(Shot(picture.stem, where, picture, mask, pose, lens))
    return turned_up(folder, split, f"IDR layout ({path.name})", shots, lost)


def decomposed(matrix: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics K [3, 3], with 1 at its end, and camera-to-world [3, 4], axes as in `Cameras`, of
    a projection K [R t] [3, 4] of any scale and sign."""
    matrix = matrix * (1 if np.linalg.det(matrix[:, :3]) > 0 else -1)
    if not np.linalg.cond(matrix[:, :3]) < 1e12:
        raise DataError(f"{where}: expected an invertible projection matrix, got a singular one")
    upper, rotation = rq(matrix[:, :3])
    signs = np.sign(np.diag(upper))  # focal lengths are positive; that they are so is all there is
    upper, rotation = upper * signs, signs[:, None] * rotation
    position = -np.linalg.solve(matrix[:, :3], matrix[:, 3])
    pose = pose_of(np.column_stack([rotation.T @ TO_OPENGL, position]), where)
    return upper / upper[2, 2], pose


def _matrices(path: Path) -> dict[int, np.ndarray]:
    """[3, 4] from the world to pixels, by number."""
    arrays = read_npz(path, PREFIX)
    found = {int(key.removeprefix(PREFIX)): a for key, a in arrays.items() if KEY.fullmatch(key)}
    if not found:
        raise DataError(f"{path}: expected arrays world_mat_0, world_mat_1 and so on, got none")
    for number, matrix in found.items():
        if matrix.shape not in ((4, 4), (3, 4)) or matrix.dtype.kind not in "fiu":
            raise DataError(
                f"{path}: expected a 4x4 matrix of numbers as world_mat_{number}, got "
                f"{list(matrix.shape)} of {matrix.dtype}"
            )
        if not np.isfinite(matrix).all():
            raise DataError(f"{path}: world_mat_{number} contains NaN or infinity")
    return {number: matrix[:3].astype(np.float64) for number, matrix in found.items()}


def _first_ordered(folder: Path, *places: str) -> list[Path]:
    """The pictures of the first of some folders that has any, in order of their names: 9.png before
    10.png, where names are numbers or differ in one."""
    pictures = next((found for name in places if (found := photographs_in(folder / name))), [])
    numbers = _counted(pictures)
    return (
        pictures if numbers is None else [pictures[i] for i in np.argsort(numbers, kind="stable")]
    )


def _counted(pictures: list[Path]) -> list[int] | None:
    """The number in each name, where that is all in which names differ: view_9.png, view_10.png."""
    parts = [re.split("([0-9]+)", path.stem) for path in pictures]
    if len({len(words) for words in parts}) != 1:
        return None
    differ = [words for words in zip(*parts, strict=True) if len({*words}) > 1]
    if len(pictures) == 1:
        differ = [words for words in zip(*parts, strict=True) if words[0].isdecimal()]
    if len(differ) != 1 or not all(word.isdecimal() for word in differ[0]):
        return None
    return [int(word) for word in differ[0]]


def _numbers(path: Path, known: list[int], pictures: list[Path]) -> list[int]:
    """The number of each picture's matrix."""
    if len(pictures) == len(known):
        return known
    found = _counted(pictures)
    if found and set(found) <= set(known) and len(set(found)) == len(found):
        return found
    raise DataError(
        f"{path}: expected a matrix world_mat for each of {len(pictures)} photographs in "
        f"{pictures[0].parent}, got {len(known)}, whose numbers do not match the photographs' names"
    )


def _masks(folder: Path, pictures: list[Path]) -> Sequence[Path | None]:
    """The masks of photographs: by their places where no name tells."""
    listed = _first_ordered(folder, "mask", "masks")
    named = find_masks(folder, [(path.stem, path) for path in pictures])
    if any(named) or len(listed) != len(pictures):
        return [None] * len(pictures)  # `read_shots` finds those that names tell
    return listed


# NeILF and NeILF++.
#
# Source: the public code of Yao et al. 2022 (NeILF), `load_cams_from_sfmscene`.


PLACED = 2  # as flg of an image


def list_neilf(folder: Path, split: str, path: Path) -> Listed:
    names, images = _read(path)
    pictures = folder / "inputs" / "images"
    known = {index for index, image in images.items() if isinstance(image, dict)}
    placed = [i for i in names if i in known and images[i].get("flg") == PLACED]
    if not placed:
        raise DataError(f"{path}: expected images with cameras (flg is {PLACED}), got none")

    def shot(index: str) -> Shot | str:
        where = f"{path}: image {index}"
        picture = listed_image(pictures, names[index], where)
        if picture is None:
            return names[index]
        lens, pose = _camera(images[index], where)
        return Shot(picture.stem, where, picture, None, pose, fitted(lens, picture, where))

    shots, lost = present(path, map(shot, placed), f" (looked in {pictures})")
    if unplaced := len(names) - len(placed):
        lost.append(f"{unplaced} photographs left out because they have no camera")
    return turned_up(folder, split, "NeILF layout", shots, lost)


def _read(path: Path) -> tuple[dict[str, str], dict]:
    """Names of photographs and what is said of them, both by index."""
    try:
        root = read_json(inside(path, str(path)))
        names = (root["image_path"] if "image_path" in root else root["image_list"])["file_paths"]
        images = root["camera_track_map"]["images"]
        if isinstance(names, list):
            names = {str(index): name for index, name in enumerate(names)}
        found = {index: PureWindowsPath(name).name for index, name in names.items()}
        if not isinstance(images, dict) or not found:
            raise TypeError("no images are listed")
    except (KeyError, TypeError, AttributeError) as error:
        raise DataError(
            f"{path}: expected JSON with image_path.file_paths and camera_track_map.images, "
            f"but reading these failed: {error!r}"
        ) from None
    return found, images


def _camera(image: dict, where: str) -> tuple[Lens, np.ndarray]:
    """Lens and pose of an image, whose extrinsic leads from the world to the camera."""
    try:
        camera = image["camera"]
        focal, centre = camera["intrinsic"]["focal"], camera["intrinsic"]["ppt"]
        values = {"fl_x": focal[0], "fl_y": focal[1], "cx": centre[0], "cy": centre[1]}
        values |= {"w": image["size"][0], "h": image["size"][1]}
        to_camera = np.array(camera["extrinsic"], np.float64).reshape(4, 4)
    except (KeyError, IndexError, TypeError, ValueError, OverflowError) as error:
        raise DataError(
            f"{where}: expected size [w, h] and a camera with focal, ppt and an extrinsic of 16 "
            f"numbers, got {short(image)} ({error!r})"
        ) from None
    width, height = (int(read_number(values, key, where, 0, math.inf)) for key in ("w", "h"))
    rotation = pose_of(to_camera, where)[:, :3].T
    pose = np.column_stack([rotation @ TO_OPENGL, -rotation @ to_camera[:3, 3]])
    return lens_of(values, where, width, height), pose


# TensoIR-Synthetic, and NeRFactor's scenes: <split>_NNN/metadata.json beside rgba_<light>.png, a
# photograph under a light, or rgba.png.


LIGHT = "sunset"  # of the photographs that the data set is trained on, where there are several


def _views(folder: Path) -> list[Path]:
    return sorted(path.parent for path in folder.glob("*_[0-9][0-9][0-9]/metadata.json"))


def is_tensoir(folder: Path, split: str) -> bool:
    return bool(_views(folder))


def list_tensoir(folder: Path, split: str, _: object) -> Listed:
    """Photographs under the light of the training views."""
    views = sorted(path.parent for path in folder.glob(f"{split}_*/metadata.json"))
    if not views:
        raise DataError(f"{folder}: expected {split}_000/metadata.json and so on, found none")
    picture = photographed(folder)
    there = [view for view in views if (view / picture).is_file()]
    missing = [view / picture for view in views if view not in there]
    remarks = left_out(str(folder), missing, len(views))
    shots = [_shot(view, picture) for view in there]
    return Listed(f"TensoIR layout ({picture})", shots, remarks)


def photographed(folder: Path) -> str:
    """Name of the pictures that are trained on: rgba.png, rgba_sunset.png or the only one."""
    views = sorted(_views(folder), key=lambda view: not view.name.startswith("train_"))
    first = next((view for view in views if any(view.glob("rgba*.png"))), views[0])
    names = sorted(path.name for path in first.glob("rgba*.png"))
    for name in ("rgba.png", f"rgba_{LIGHT}.png"):
        if name in names:
            return name
    if len(names) != 1:
        raise DataError(
            f"{first}: expected rgba.png, rgba_{LIGHT}.png or one rgba_<light>.png, got "
            + (", ".join(names) or "none")
        )
    return names[0]


def _shot(view: Path, picture: str) -> Shot:
    path = view / "metadata.json"
    meta = read_json(inside(path, str(path)))
    try:
        text = meta["cam_transform_mat"]
        values = [float(value) for value in text.split(",")]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(
            f"{path}: expected JSON with cam_transform_mat, numbers separated by commas, but "
            f"reading it failed: {error!r}"
        ) from None
    if len(values) != 16:
        raise DataError(f"{path}: expected 16 numbers in cam_transform_mat, got {short(text)}")
    image = view / picture
    angle = read_number(meta, "cam_angle_x", str(path), 0.0, math.pi)
    camera = {"camera_angle_x": angle}
    camera |= {to: meta[key] for to, key in (("w", "imw"), ("h", "imh")) if key in meta}
    pose = pose_of(np.reshape(values, (4, 4)), str(path))
    lens = lens_of(camera, str(path), *image_size(image))
    return Shot(view.name, str(path), image, None, pose, lens)
