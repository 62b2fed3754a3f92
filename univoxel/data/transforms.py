"""Cameras in the JSON of NeRF: what its layouts share, and camera paths without pictures.

{"camera_angle_x" (or "fl_x", "fl_y", "cx", "cy"), "w", "h", "k1" .., "p1", "p2", "frames": [
    {"file_path": .., "transform_matrix": camera-to-world with OpenGL axes, "mask_path": ..}]}

Everything but frames may stand with a frame too.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from univoxel.camera import Cameras
from univoxel.data.images import SUFFIXES, image_size, turn_note
from univoxel.data.lens import Lens
from univoxel.data.shots import Shot, cameras_of
from univoxel.errors import DataError
from univoxel.files import replacing

# How far the axes of a camera may be from orthonormal. Six printed digits give 1e-6; what is off
# by more than this was scaled or sheared.
RIGID_TOLERANCE = 1e-3
MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")


def load_cameras(path: str | Path, size: int) -> tuple[list[str], Cameras]:
    """Names and cameras of a file in the form of transforms_<split>.json, without pictures.

    Args:
        size: pixels, width and height of the pictures to come where the file gives no w and h,
            for all or with a frame.

    Returns:
        A name for each frame, from its file_path or its number, and the cameras.

    Raises:
        DataError: one line that names the file, what was expected and what came.
    """
    path = Path(path)
    if not path.is_file():
        raise DataError(f"{path}: expected a file of cameras, got nothing there")
    root, frames = read_transforms(path)
    names = [view_name(str(f.get("file_path", f"{i:04d}"))) for i, f in enumerate(frames)]
    if len(set(names)) != len(names):
        raise DataError(f"{path}: expected every frame under a name of its own")
    poses, lenses = [], []
    for index, frame in enumerate(frames):
        where = f"{path}: frame {index}"
        poses.append(pose_of(frame.get("transform_matrix"), where))
        values = {"w": size, "h": size} | root | frame
        width, height = (int(number(values, key, where, 0, math.inf)) for key in ("w", "h"))
        lens = lens_of(values, where, width, height)
        if lens.bent:
            raise DataError(f"{where}: expected cameras without lens distortion, got some")
        lenses.append(lens)
    return names, cameras_of(poses, lenses)


def read_transforms(path: Path) -> tuple[dict, list[dict]]:
    """The root of the file, and its frames."""
    try:
        root = json.loads(path.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise DataError(
            f"{path}: broken JSON in line {error.lineno}, column {error.colno}: {error.msg}"
        ) from None
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: expected text in UTF-8, got {error.reason}") from None
    if not isinstance(root, dict):
        raise DataError(f"{path}: expected a JSON object, got {short(root)}")
    frames = root.get("frames")
    if not isinstance(frames, list) or not frames:
        raise DataError(f"{path}: expected a list of frames, got {short(frames)}")
    for index, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise DataError(f"{path}: frame {index}: expected an object, got {short(frame)}")
    return root, frames


def read_frames(path: Path) -> tuple[dict, list[Shot]]:
    """The root of the file, and its frames with their pictures, which lie relative to it."""
    root, frames = read_transforms(path)
    shots = []
    for index, frame in enumerate(frames):
        where = f"{path}: frame {index}"
        file_path = frame.get("file_path")
        if not isinstance(file_path, str):
            raise DataError(f"{where}: expected an object with a file_path, got {short(file_path)}")
        image = find_image(path.parent, file_path, where)
        shots.append(
            Shot(
                name=view_name(file_path),
                where=where,
                image=image,
                mask=_mask(path.parent, frame, where),
                pose=pose_of(frame.get("transform_matrix"), where),
                lens=lens_of(root | frame, where, *image_size(image), turn_note(image)),
            )
        )
    return root, shots


def find_image(folder: Path, file_path: str, where: str) -> Path:
    """The picture that a frame's file_path means, with or without its extension."""
    endings = ("", ".png", "_rgba.png", "_rgb.exr", ".exr", ".jpg")
    for ending in endings:
        if (path := folder / (file_path + ending)).is_file():
            return path
    raise DataError(
        f"{where}: no picture {folder / file_path} (looked for the endings "
        f"{', '.join(ending or 'none' for ending in endings)})"
    )


def view_name(file_path: str) -> str:
    """./train/r_000 and ./train/r_000.png are r_000; r_0.5 stays."""
    path = Path(file_path)
    name = path.stem if path.suffix.lower() in SUFFIXES else path.name
    return name.removesuffix("_rgba").removesuffix("_rgb")


def pose_of(matrix: object, where: str) -> np.ndarray:
    """Camera-to-world [3, 4] with its axes made exactly orthonormal."""
    try:
        pose = np.array(matrix, np.float64)
    except (TypeError, ValueError):
        pose = np.empty(0)
    if pose.shape not in ((4, 4), (3, 4)) or not np.isfinite(pose).all():
        raise DataError(f"{where}: expected a finite 4x4 transform_matrix, got {short(matrix)}")
    if len(pose) == 4 and not np.allclose(pose[3], [0, 0, 0, 1], atol=RIGID_TOLERANCE, rtol=0):
        raise DataError(f"{where}: expected the last row 0 0 0 1, got {pose[3].tolist()}")
    u, scale, v = np.linalg.svd(pose[:3, :3])
    if np.abs(scale - 1).max() > RIGID_TOLERANCE:
        raise DataError(
            f"{where}: expected a rigid transform_matrix (a rotation), got one that scales by "
            f"{scale[0]:.4g}, {scale[1]:.4g}, {scale[2]:.4g}"
        )
    if np.linalg.det(pose[:3, :3]) < 0:
        raise DataError(f"{where}: expected a rotation in transform_matrix, got a reflection")
    return np.concatenate([u @ v, pose[:3, 3:]], 1)


def lens_of(values: dict, where: str, width: int, height: int, note: str = "") -> Lens:
    """The lens that a frame's values describe, for pictures of this size.

    Args:
        note: on the size, added to the message that it is another one.
    """
    # Focal lengths are in pixels: of these pictures, or all is off.
    if (values.get("w", width), values.get("h", height)) != (width, height):
        raise DataError(
            f"{where}: expected pictures of {values.get('w')}x{values.get('h')} pixels (w and h), "
            f"got {width}x{height}{note}"
        )
    model = values.get("camera_model", "OPENCV")
    if values.get("is_fisheye") or model not in MODELS:
        raise DataError(
            f"{where}: expected one of the camera models {', '.join(MODELS)}, got "
            + ("a fisheye" if values.get("is_fisheye") else short(model))
        )
    if values.get("k4"):
        raise DataError(f"{where}: expected distortion by k1 k2 k3 p1 p2, got k4 too")
    if "fl_x" in values:
        x = number(values, "fl_x", where, 0.0, math.inf)
        y = number(values, "fl_y", where, 0.0, math.inf) if "fl_y" in values else x
    else:
        angle = number(values, "camera_angle_x", where, 0.0, math.pi)
        x = y = 0.5 * width / math.tan(0.5 * angle)
    bent = {
        key: number(values, key, where, -math.inf, math.inf) if key in values else 0.0
        for key in ("k1", "k2", "k3", "p1", "p2")
    }
    return Lens(
        width,
        height,
        focal=(x, y),
        centre=(
            number(values, "cx", where, -width, 2 * width) if "cx" in values else width / 2,
            number(values, "cy", where, -height, 2 * height) if "cy" in values else height / 2,
        ),
        radial=(bent["k1"], bent["k2"], bent["k3"]),
        tangential=(bent["p1"], bent["p2"]),
    )


def number(values: dict, key: str, where: str, low: float, high: float) -> float:
    value = values.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not low < value < high:
        came = "nothing" if value is None else short(value)
        raise DataError(f"{where}: expected {key} between {low:.4g} and {high:.4g}, got {came}")
    return float(value)


def short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def write_cameras(folder: Path, split: str, cameras: Cameras, names: Sequence[str]) -> None:
    """Write transforms_SPLIT.json for pictures SPLIT/NAME of the cameras.

    Raises:
        OSError: it cannot be written; what was there before stays.
    """
    frames = []
    for view, pose in enumerate(cameras.camera_to_world.tolist()):
        (x, y), (cx, cy) = cameras.focal[view].tolist(), cameras.centre[view].tolist()
        frames.append(
            {
                "file_path": f"{split}/{names[view]}",
                "transform_matrix": [*pose, [0.0, 0.0, 0.0, 1.0]],
                **{"fl_x": x, "fl_y": y, "cx": cx, "cy": cy},
            }
        )
    with replacing(folder / f"transforms_{split}.json") as temporary:
        temporary.write_text(json.dumps({"frames": frames}, indent=1), encoding="utf-8")


def _mask(folder: Path, frame: dict, where: str) -> Path | None:
    named = frame.get("mask_path")
    if named is None:
        return None
    if not isinstance(named, str) or not (folder / named).is_file():
        raise DataError(f"{where}: no mask {folder / str(named)} (mask_path)")
    return folder / named
