"""The layout of NeILF and NeILF++.

inputs/sfm_scene.json       image_path.file_paths: names by index; camera_track_map.images: by
                            index size [w, h], flg (2: placed), and camera: intrinsic (focal, ppt)
                            and extrinsic, 16 numbers from the world to the camera
inputs/images/<name>        photographs, under the last part of their names, of any ending
inputs/masks/<name>.png     masks, also in inputs/pmasks and masks, or alpha in the photographs

Source: the public code of Yao et al. 2022 (NeILF), `load_cams_from_sfmscene`.
"""

from __future__ import annotations

import math
from pathlib import Path, PureWindowsPath

import numpy as np

from univoxel.data.base import Photos
from univoxel.data.foreign import TO_OPENGL
from univoxel.data.inside import inside
from univoxel.data.lens import Lens, fitted
from univoxel.data.missing import left_out
from univoxel.data.shots import Shot, every_eighth, read_shots, upright
from univoxel.data.transforms import lens_of, listed_image, number, pose_of, short
from univoxel.errors import DataError
from univoxel.files import read_json

FILE = "inputs/sfm_scene.json"
PLACED = 2  # as flg of an image


def is_neilf(folder: Path, split: str) -> bool:
    return (folder / FILE).is_file()


def load_neilf(
    folder: Path, split: str = "train", downscale: int = 0, masks: bool | Path = True
) -> Photos:
    """Photographs and cameras of one split: every eighth is for tests.

    The world keeps its scale and origin, and is turned so that +Z is up.

    Raises:
        DataError: one line that names the file, what was expected and what came.
    """
    path = folder / FILE
    names, images = _read(path)
    shots, missing, unplaced = [], [], 0
    for index, name in names.items():
        where = f"{path}: image {index}"
        image = images.get(index)
        if not isinstance(image, dict) or image.get("flg") != PLACED:
            unplaced += 1
            continue
        picture = listed_image(folder / "inputs" / "images", name, where)
        if picture is None:
            missing.append(name)
            continue
        lens, pose = _camera(image, where)
        shots.append(Shot(picture.stem, where, picture, None, pose, fitted(lens, picture, where)))
    if unplaced == len(names):
        raise DataError(f"{path}: expected images with flg {PLACED}, which have cameras, got none")
    looked = f" (looked in {folder / 'inputs' / 'images'})"
    lost = left_out(str(path), missing, len(names) - unplaced, looked)
    lost += [f"{unplaced} without a camera left out"] if unplaced else []
    shots, remarks = upright(shots)
    shots = every_eighth(folder, shots, split)
    return read_shots(folder, "NeILF layout", split, shots, downscale, [*lost, *remarks], masks)


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
            raise TypeError("no images")
    except DataError:
        raise
    except (KeyError, TypeError, AttributeError) as error:
        raise DataError(
            f"{path}: expected JSON with image_path.file_paths and camera_track_map.images, "
            f"got {error!r}"
        ) from None
    return found, images


def _camera(image: dict, where: str) -> tuple[Lens, np.ndarray]:
    """Lens and pose of an image."""
    try:
        camera = image["camera"]
        focal, centre = camera["intrinsic"]["focal"], camera["intrinsic"]["ppt"]
        values = {"fl_x": focal[0], "fl_y": focal[1], "cx": centre[0], "cy": centre[1]}
        values |= {"w": image["size"][0], "h": image["size"][1]}
        matrix = camera["extrinsic"]
        to_camera = np.array(matrix, np.float64).reshape(4, 4)
    except (KeyError, IndexError, TypeError, ValueError, OverflowError) as error:
        raise DataError(
            f"{where}: expected size [w, h] and a camera of focal, ppt and 16 numbers as "
            f"extrinsic, got {short(image)} ({error!r})"
        ) from None
    width, height = (int(number(values, key, where, 0, math.inf)) for key in ("w", "h"))
    rotation = pose_of(to_camera, where)[:, :3].T
    pose = np.column_stack([rotation @ TO_OPENGL, -rotation @ to_camera[:3, 3]])
    return lens_of(values, where, width, height), pose
