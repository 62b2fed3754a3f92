"""Cameras in NeRF's JSON: NeRF-synthetic, nerfstudio, and camera paths without images; and names,
numbers and axes as all layouts have them."""

from __future__ import annotations

import math
import os
import re
import reprlib
from collections.abc import Sequence
from contextlib import suppress
from itertools import starmap
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np

from univoxel.camera import Cameras
from univoxel.core import log, system
from univoxel.core.files import read_json, write_json
from univoxel.data import load_images
from univoxel.data.images import FOREIGN, SUFFIXES, image_size, turn_note
from univoxel.data.lens import FARTHEST, Lens, checked, fitted, is_shrunk
from univoxel.data.path_sandbox import entries, inside
from univoxel.errors import DataError, UserError

# The JSON of NeRF:
#
# {"camera_angle_x" (or "fl_x", "fl_y", "cx", "cy"), "w", "h", "k1" .., "p1", "p2", "frames": [
#     {"file_path": .., "transform_matrix": camera-to-world with OpenGL axes, "mask_path": ..}]}
#
# Everything but frames may stand with a frame too. Where it has a scene_name, its file_path is
# relative to the folder of that name beside the file's (Stanford-ORB's transforms_novel.json).


# How far the axes of a camera may be from orthonormal. Six printed digits give 1e-6; what is off
# by more than this was scaled or sheared.
RIGID_TOLERANCE = 1e-3
CAPITAL = (".JPG", ".JPEG", ".PNG")
ENDINGS = ("", ".png", "_rgba.png", "_rgb.exr", ".exr", ".jpg", ".jpeg", *CAPITAL)
LOOKED_FOR = f"looked for the endings {', '.join(ending or 'none' for ending in ENDINGS)}"
# That may be written as text
NUMBERS = {"w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x"}
NUMBERS |= {"k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"}
WIDEST = 1 << 16  # pixels along a side of pictures to be made: what formats of files hold
TO_OPENGL = np.diag([1.0, -1.0, -1.0])  # of camera axes: x right, y down, z forward in OpenCV
SKEW = 0.5  # pixels by which lines may lean and are taken as upright: no mask is as sharp
OFF = 0.9  # of a picture's sides: no lens is centred so far to the right and below
MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")

_SHORT = reprlib.Repr()  # writes the beginning of values of any size and depth
_SHORT.maxlist = _SHORT.maxdict = 20
_SHORT.maxstring = _SHORT.maxlong = _SHORT.maxother = 200


def load_cameras(
    path: str | Path, size: int, moved: np.ndarray | None = None
) -> tuple[list[str], Cameras]:
    """Names and cameras of a file in the form of transforms_<split>.json, without pictures.

    Args:
        size: pixels, width and height of the pictures to come where the file gives no w and h,
            for all or with a frame.
        moved: from the file's world to that of the cameras, as in `Photos`.

    Returns:
        A name for each frame, from its file_path or its number, and the cameras.

    Raises:
        DataError: one line that names the file, what was expected and what came.
    """
    path = Path(path)
    if not path.is_file():
        raise DataError(f"{path}: this camera file does not exist")
    root, frames = read_transforms(path)
    names = view_names([str(f.get("file_path", f"{i:04d}")) for i, f in enumerate(frames)])
    for index, name in enumerate(names):
        load_images.check_name(name, f"{path}: frame {index}")
    if len(set(names)) != len(names):
        raise DataError(f"{path}: expected frames with unique names")
    poses, lenses = [], []
    for index, frame in enumerate(frames):
        where = f"{path}: frame {index}"
        pose = pose_of(frame.get("transform_matrix"), where)
        poses.append(pose if moved is None else load_images.after(moved, pose))
        values = {"w": size, "h": size} | root | frame
        width, height = (int(read_number(values, key, where, 0, WIDEST)) for key in ("w", "h"))
        lens = lens_of(values, where, width, height)
        if lens.bent:
            raise DataError(f"{where}: expected cameras without distortion, got distorted ones")
        lenses.append(lens)
    return names, load_images.cameras_of(poses, lenses)


def read_transforms(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The root of the file, and its frames."""
    root = read_json(inside(path, str(path)))
    if not isinstance(root, dict):
        raise DataError(f"{path}: expected a JSON object, got {short(root)}")
    frames = root.get("frames")
    if not isinstance(frames, list) or not frames:
        raise DataError(f"{path}: expected a list of frames, got {short(frames)}")
    for index, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise DataError(f"{path}: frame {index}: expected a JSON object, got {short(frame)}")
    frames = [_understood(frame) for frame in frames]
    return _understood(root), frames


def _understood(values: dict[str, Any]) -> dict[str, Any]:
    """Without keys whose value is null, as some write all that they know of; numbers that are
    written as text are numbers, and whole ones of pixels are integers."""
    values = {key: value for key, value in values.items() if value is not None}
    for key in NUMBERS & values.keys():
        if isinstance(value := values[key], str):
            with suppress(ValueError):
                value = float(value)
        if key in ("w", "h") and isinstance(value, float) and value.is_integer():
            value = int(value)
        values[key] = value
    return values


def read_frames(path: Path) -> tuple[dict[str, Any], list[load_images.Shot], list[str]]:
    """The root of the file, its frames with their pictures, which lie relative to it, and remarks.

    Frames without a picture are left out, as `left_out` says.
    """
    root, frames = read_transforms(path)
    for index, frame in enumerate(frames):  # all of them, before a picture is opened
        where, file_path = f"{path}: frame {index}", frame.get("file_path")
        if not isinstance(file_path, str) or "\0" in file_path:
            raise DataError(f"{where}: expected text in file_path, got {short(file_path)}")
    names = [_name(frame, view_name(frame["file_path"])) for frame in frames]
    if len(set(names)) < len(names):
        longer = view_names([frame["file_path"] for frame in frames])
        names = [_name(frame, name) for frame, name in zip(frames, longer, strict=True)]
    if len(set(names)) < len(names):
        index = next(i for i, name in enumerate(names) if name in names[:i])
        raise DataError(
            f"{path}: frame {index}: the name {names[index]} of {frames[index]['file_path']} "
            "occurs twice"
        )
    scaled = 0

    def shot(index: int, frame: dict[str, Any]) -> load_images.Shot | Path:
        nonlocal scaled
        where, file_path = f"{path}: frame {index}", frame["file_path"]
        folder = _folder(path, frame, where)
        image = listed_image(folder, file_path, where)
        if image is None:
            return folder / file_path
        lens = _lens(root | frame, where, image)
        scaled += lens.width < (root | frame).get("w", 0)
        pose, mask = pose_of(frame.get("transform_matrix"), where), _mask(path.parent, frame, where)
        return load_images.Shot(names[index], where, image, mask, pose, lens)

    found = list(starmap(shot, enumerate(frames)))
    shots, lost = load_images.present(path, found, f" ({LOOKED_FOR}{_smaller(found)})")
    first = shots[0].lens
    if "w" not in root | frames[0] and all(
        c > OFF * n for c, n in zip(first.centre, (first.width, first.height), strict=True)
    ):
        log.warning(
            "%s: cx and cy are near or beyond the border of the %dx%d images; if they refer to "
            "larger images, add the width and height of those as w and h",
            *(path, first.width, first.height),
        )
    lost += [f"{scaled} cameras scaled to match smaller images"] if scaled else []
    return root, shots, lost


def _lens(values: dict[str, Any], where: str, image: Path) -> Lens:
    """The lens of a picture, which may be smaller than those that the lens was found with."""
    width, height = image_size(image)
    given = values.get("w", width), values.get("h", height)
    if all(isinstance(n, int) and n > 0 for n in given) and is_shrunk(width, height, given):
        return fitted(lens_of(values, where, *given), image, where)
    return lens_of(values, where, width, height, turn_note(image))


def _smaller(found: Sequence[load_images.Shot | Path]) -> str:
    """A word on folders of shrunk copies of pictures that are missing, such as images_2."""
    missing = next((path for path in found if isinstance(path, Path)), None)
    if missing is None:
        return ""
    place = missing.parent
    others = sorted(p.name for p in place.parent.glob(f"{place.name}_*") if p.is_dir())
    if not others:
        return ""
    return (
        f"; {others[0]} exists: rename it to {place.name}, so that cameras are scaled to its images"
    )


def _name(frame: dict[str, Any], name: str) -> str:
    """Unique within a file: Stanford-ORB's novel views are of several scenes."""
    return f"{scene}_{name}" if isinstance(scene := frame.get("scene_name"), str) else name


def _folder(path: Path, frame: dict[str, Any], where: str) -> Path:
    """What a frame's file_path is relative to: the file's folder, or that of another scene."""
    scene = frame.get("scene_name")
    if scene is None:
        return path.parent
    if not isinstance(scene, str) or Path(scene).name != scene or scene in ("", ".."):
        raise DataError(f"{where}: expected the name of a folder as scene_name, got {short(scene)}")
    return path.parent.resolve().parent / scene


def find_image(folder: Path, file_path: str, where: str) -> Path:
    """The picture that a frame's file_path means, as in `listed_image`; a DataError without one."""
    found = listed_image(folder, file_path, where)
    if found is None:
        raise DataError(f"{where}: the image {folder / file_path} does not exist ({LOOKED_FOR})")
    return found


def listed_image(folder: Path, file_path: str, where: str) -> Path | None:
    """The picture that a name in a file means: as it is, without its ending, or with another."""
    names = [file_path + ending for ending in ENDINGS]
    if (named := Path(file_path)).suffix.lower() in (*SUFFIXES, *FOREIGN):
        names += [str(named.with_suffix(ending)) for ending in (*SUFFIXES, *CAPITAL)]
    # Of `os`, as it does not raise of names that no file can have
    found = next((path for name in names if os.path.isfile(path := folder / name)), None)
    found = found or _found_as_written_elsewhere(folder, names, where)
    return None if found is None else inside(found, where)


def _found_as_written_elsewhere(folder: Path, names: Sequence[str], where: str) -> Path | None:
    """A file that a list names as another machine has it: with backslashes, in capitals or not,
    accents apart from their letters or not, or by an absolute path, of which the end says which it
    is in the folder. Two files that are called so are a DataError."""
    of_windows = "\\" in names[0] or re.match("[A-Za-z]:/", names[0])
    paths = [PureWindowsPath(name) if of_windows else PurePosixPath(name) for name in names]
    if any(".." in path.parts for path in paths):
        return None
    absolute, known = bool(paths[0].anchor), {}
    for begin in range(len(paths[0].parts) if absolute else 1):
        for path in paths:
            parts = path.parts[begin + absolute :]
            found = _in_any_case(folder, parts, known) if parts else []
            if len(found) > 1:
                both = " and ".join(map(str, found[:2]))
                raise DataError(f"{where}: expected one image named {path}, got {both}: rename one")
            if found:
                return found[0]
    return None


def _in_any_case(
    folder: Path, parts: Sequence[str], known: dict[Path, dict[str, list[Path]]]
) -> list[Path]:
    """The files of a folder whose path is this, but for capitals and how accents are written.

    Args:
        known: what is in folders, by its name as in `system.folded`; it is added to.
    """
    found = [folder]
    for part in parts:
        for folder in found:
            if folder not in known:
                known[folder] = {}
                for path in entries(folder):
                    known[folder].setdefault(system.folded(path.name), []).append(path)
        found = [p for f in found for p in known[f].get(system.folded(part), [])]
    return [path for path in found if path.is_file()]


def find_photo(folder: Path, name: str, where: str) -> Path | None:
    """A photograph by its name in a list of them: in images/ or in the folder itself."""
    return listed_image(folder / "images", name, where) or listed_image(folder, name, where)


def looked_in(folder: Path) -> str:
    """Where `find_photo` looks, as `present` takes it."""
    return f" (looked in {folder / 'images'} and {folder})"


def view_names(file_paths: Sequence[str]) -> list[str]:
    """Names of views, with the folders in front where names alone come twice."""
    names = [view_name(file_path) for file_path in file_paths]
    if len({system.file_key(name) for name in names}) == len(names):
        return names
    folders = [PurePosixPath(p.replace("\\", "/")).parts[:-1] for p in file_paths]
    differ = [len(set(level)) > 1 for level in zip(*folders, strict=False)]
    shared = [*differ, True].index(True)
    return ["_".join([*parts[shared:], name]) for parts, name in zip(folders, names, strict=True)]


def view_name(file_path: str) -> str:
    """./train/r_000 and ./train/r_000.png are r_000; r_0.5 stays."""
    path = PurePosixPath(file_path.replace("\\", "/"))
    name = path.stem if path.suffix.lower() in (*SUFFIXES, *FOREIGN) else path.name
    return name.removesuffix("_rgba").removesuffix("_rgb")


def pose_of(matrix: object, where: str) -> np.ndarray:
    """Camera-to-world [3, 4] with its axes made exactly orthonormal."""
    try:
        pose = np.array(matrix, np.float64)
    except (TypeError, ValueError, OverflowError):
        pose = np.empty(0)
    if pose.shape not in ((4, 4), (3, 4)) or not np.isfinite(pose).all():
        raise DataError(f"{where}: expected a finite 4x4 transform_matrix, got {short(matrix)}")
    if len(pose) == 4 and not np.allclose(pose[3], [0, 0, 0, 1], atol=RIGID_TOLERANCE, rtol=0):
        raise DataError(f"{where}: transform_matrix must end with 0 0 0 1, got {pose[3].tolist()}")
    if (largest := np.abs(pose).max()) > FARTHEST:
        raise DataError(f"{where}: expected matrix values up to {FARTHEST:.0e}, got {largest:.4g}")
    u, scale, v = np.linalg.svd(pose[:3, :3])
    if np.abs(scale - 1).max() > RIGID_TOLERANCE:
        raise DataError(
            f"{where}: expected rotation and translation in transform_matrix, got a scale of "
            f"{scale[0]:.4g}, {scale[1]:.4g}, {scale[2]:.4g}"
        )
    if np.linalg.det(pose[:3, :3]) < 0:
        raise DataError(f"{where}: expected a rotation in transform_matrix, got a reflection")
    return np.concatenate([u @ v, pose[:3, 3:]], 1)


def lens_of(values: dict[str, Any], where: str, width: int, height: int, note: str = "") -> Lens:
    """The lens that a frame's values describe, for pictures of this size.

    Args:
        note: on the size, added to the message that it is another one.
    """
    # Focal lengths are in pixels: of these pictures, or all is off.
    if (values.get("w", width), values.get("h", height)) != (width, height):
        raise DataError(
            f"{where}: expected images of {values.get('w')}x{values.get('h')} pixels (w and h), "
            f"got {width}x{height}{note}"
        )
    model = values.get("camera_model", "OPENCV")
    if values.get("is_fisheye") or model not in MODELS:
        raise DataError(
            f"{where}: expected one of the camera models {', '.join(MODELS)}, got "
            + ("a fisheye" if values.get("is_fisheye") else short(model))
        )
    if more := [key for key in ("k4", "k5", "k6") if values.get(key)]:
        raise DataError(f"{where}: expected only distortion terms k1 k2 k3 p1 p2, got {more[0]}")

    def number(key: str, usual: float, low: float = -math.inf, high: float = math.inf) -> float:
        return read_number(values, key, where, low, high) if key in values else usual

    if "fl_x" in values:
        x = number("fl_x", 0.0, low=0.0)
        y = number("fl_y", x, low=0.0)
    else:
        angle = read_number(values, "camera_angle_x", where, 0.0, math.pi)
        x = y = 0.5 * width / math.tan(0.5 * angle)
    k1, k2, k3, p1, p2 = (number(key, 0.0) for key in ("k1", "k2", "k3", "p1", "p2"))
    radial, tangential = (k1, k2, k3), (p1, p2)
    centre = (
        number("cx", width / 2, -width, 2 * width),
        number("cy", height / 2, -height, 2 * height),
    )
    try:
        return checked(Lens(width, height, (x, y), centre, radial, tangential))
    except UserError as error:
        raise DataError(f"{where}: {error}") from None


def read_number(values: dict[str, Any], key: str, where: str, low: float, high: float) -> float:
    """A number of a frame; a DataError where it is missing, no number, or not between two
    others."""
    value = values.get(key)
    try:
        if isinstance(value, int | float) and not isinstance(value, bool):
            if low < (found := float(value)) < high:
                return found
    except OverflowError:  # an integer of hundreds of digits
        pass
    came = "nothing" if value is None else short(value)
    raise DataError(f"{where}: expected {key} between {low:.4g} and {high:.4g}, got {came}")


def parsed(text: str | None, what: str, where: str) -> float:
    """A finite number from text; a DataError where it is missing or another text."""
    try:
        value = float(text) if text is not None else math.nan
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        came = "nothing" if text is None else short(text)
        raise DataError(f"{where}: expected a number for {what}, got {came}")
    return value


def check_skew(skew: float, lens: Lens, where: str) -> None:
    """Raise where x and y axes of a camera's pixels are not square to one another.

    Args:
        skew: pixels along x for each focal length along y, as in a matrix of intrinsics.
    """
    lean = abs(skew) * lens.height / 2 / lens.focal[1]
    if not lean <= SKEW:
        raise DataError(
            f"{where}: expected perpendicular rows and columns of pixels, got rows shifted by up "
            f"to {lean:.3g} pixels (skew {skew:.4g})"
        )


def short(value: object) -> str:
    """A value as Python writes it, cut off where it is long."""
    text = _SHORT.repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def write_cameras(folder: Path, split: str, cameras: Cameras, names: Sequence[str]) -> None:
    """Write transforms_SPLIT.json for pictures SPLIT/NAME of the cameras, whole or not at all."""
    frames = []
    for view, pose in enumerate(cameras.camera_to_world.tolist()):
        (x, y), (cx, cy) = cameras.focal[view].tolist(), cameras.centre[view].tolist()
        lens = {"fl_x": x, "fl_y": y, "cx": cx, "cy": cy}
        matrix = [*pose, [0.0, 0.0, 0.0, 1.0]]
        frames.append({"file_path": f"{split}/{names[view]}", "transform_matrix": matrix, **lens})
    write_json(folder / f"transforms_{split}.json", {"frames": frames})


def _mask(folder: Path, frame: dict[str, Any], where: str) -> Path | None:
    named = frame.get("mask_path")
    if named is None:
        return None
    found = None
    if isinstance(named, str) and "\0" not in named:
        found = listed_image(folder, named, where)
    if found is None:
        raise DataError(f"{where}: the mask {folder / str(named)[:200]} does not exist (mask_path)")
    return found


# The layout of NeRF-synthetic scenes, of Shiny Blender, Synthetic4Relight and Stanford-ORB, whose
# transforms_novel.json is of views of other scenes.


def is_blender(folder: Path, split: str) -> bool:
    return any((folder / f"transforms_{s}.json").is_file() for s in ("train", split))


def list_blender(folder: Path, split: str, _: object) -> load_images.Listed:
    path = folder / f"transforms_{split}.json"
    if not path.is_file():
        raise DataError(f"{folder}: {path.name} is missing beside transforms_train.json")
    _, shots, remarks = read_frames(path)
    train = folder / "transforms_train.json"
    if train.is_file():  # all splits in one world
        frames = read_transforms(train)[1] if split != "train" else []
        poses = [pose_of(f.get("transform_matrix"), str(train)) for f in frames]
        places = [pose[:, 3] for pose in poses] or [shot.pose[:, 3] for shot in shots]
        shots, moved = load_images.near_origin(shots, np.stack(places))
        remarks = [*remarks, *moved]
    return load_images.Listed("NeRF layout", shots, remarks)


# The layout of nerfstudio and instant-ngp.


def list_nerfstudio(folder: Path, split: str, path: Path) -> load_images.Listed:
    """Where the file has no train_filenames and test_filenames, every eighth is for tests."""
    root, shots, lost = read_frames(path)
    shots, remarks = load_images.upright(shots)
    chosen = root.get(f"{split}_filenames")
    if chosen is None:
        shots = load_images.every_eighth(folder, shots, split)
    else:
        listed = [frame["file_path"] for frame in root["frames"]]
        shots = _named(path, shots, listed, f"{split}_filenames", chosen)
    return load_images.Listed("nerfstudio layout", shots, [*lost, *remarks])


def _named(
    path: Path, shots: list[load_images.Shot], listed: list[str], key: str, chosen: object
) -> list[load_images.Shot]:
    """The shots of a split. What is listed and has no picture is left out of it, too."""
    if not isinstance(chosen, list) or not all(isinstance(name, str) for name in chosen):
        raise DataError(f"{path}: expected a list of file_paths as {key}, got {short(chosen)}")
    by_name, every = {shot.name: shot for shot in shots}, view_names(listed)
    known = {name: name for name in every} | dict(zip(listed, every, strict=True))
    names = [known.get(name) or known.get(view_name(name)) for name in chosen]
    if None in names or not names:
        came = view_name(chosen[names.index(None)]) if names else "an empty list"
        raise DataError(f"{path}: expected {key} to list only frames of this file, got {came}")
    found = [by_name[name] for name in names if name in by_name]
    if not found:
        raise DataError(f"{path}: expected images of the frames in {key}, found 0 of {len(names)}")
    return found
