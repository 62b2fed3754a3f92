"""COLMAP's sparse models.

Source: COLMAP's documentation, "Output Format" and "Camera Models".
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from scipy.spatial.transform import Rotation

from univoxel.data.images import image_size, turn_note
from univoxel.data.lens import FARTHEST, Lens, checked, fitted, is_shrunk
from univoxel.data.load_images import Listed, Shot, listed_split, present, turned_up
from univoxel.data.path_sandbox import inside
from univoxel.data.transforms import TO_OPENGL, find_photo, looked_in
from univoxel.errors import DataError

PLACES = ("sparse/0", "sparse", "colmap/sparse/0", ".")
# By number in binary files; of those that are supported, their parameters
MODELS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"),
    *("FULL_OPENCV", "FOV", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE"),
)
SUPPORTED = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",  # without its denominator, k4 to k6
}
# A feature of a photograph in images.bin: its pixel, and the number of the point that it shows
SEEN = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
# What reading a broken file may raise; OverflowError: of sizes of hundreds of digits
BROKEN = (struct.error, IndexError, ValueError, OverflowError)


@dataclass(frozen=True)
class Registered:
    """A photograph that the model has a pose for."""

    camera: int
    name: str  # path within the folder of photographs
    pose: np.ndarray  # [3, 4] camera-to-world, axes as in `Cameras`


def list_colmap(folder: Path, split: str, models: list[tuple[Path, str]]) -> Listed:
    model, ending = models[0]
    cameras_file, images_file = model / f"cameras{ending}", model / f"images{ending}"
    for file in (cameras_file, images_file):
        inside(file, str(file))
    file = cameras_file
    try:
        cameras, file = read_cameras(cameras_file), images_file
        images = read_images(images_file)
    except DataError:
        raise
    except BROKEN as error:
        raise DataError(f"{file}: this file of a COLMAP model could not be read: {error}") from None
    if not images:
        raise DataError(f"{images_file}: expected photographs with poses, got none")
    names: set[str] = set()
    for image in images:  # all of them, before a picture is opened
        if image.name in names or not image.name or "\0" in image.name:
            raise DataError(
                f"{images_file}: expected unique, non-empty image names, got {image.name!r}"
            )
        names.add(image.name)
    scaled = 0

    def shot(image: Registered) -> Shot | str:
        nonlocal scaled
        if image.camera not in cameras:
            raise DataError(f"{images_file}: {image.name} refers to missing camera {image.camera}")
        path = find_photo(folder, image.name, str(images_file))
        if path is None:
            return image.name
        lens = cameras[image.camera]
        width, height = image_size(path)
        if is_shrunk(width, height, (lens.width, lens.height)):
            lens, scaled = fitted(lens, path, cameras_file.name), scaled + 1
        elif (width, height) != (lens.width, lens.height):
            raise DataError(
                f"{path}: expected {lens.width}x{lens.height} pixels, the size of its "
                f"camera in {cameras_file.name}, got {width}x{height}{turn_note(path)}"
            )
        inner = PurePosixPath(image.name.replace("\\", "/"))
        name = inner.with_suffix("").as_posix().replace("/", "_")
        return Shot(name, str(images_file), path, None, image.pose, lens)

    shots, lost = present(images_file, map(shot, images), looked_in(folder))
    lost += [f"{scaled} cameras scaled to match smaller images"] if scaled else []
    if len(models) > 1:
        lost = [f"{model.relative_to(folder)}, the largest of {len(models)} models", *lost]
    return turned_up(folder, split, "COLMAP model", shots, lost, listed_split)


def read_cameras(path: Path) -> dict[int, Lens]:
    """cameras.bin or cameras.txt, by camera id; a DataError where a camera model is not supported,
    one of BROKEN where the file is broken."""
    rows = _cameras_text(path) if path.suffix == ".txt" else _cameras_binary(path)
    lenses = {}
    for number, model, width, height, p in rows:
        if any(p[9:]):
            raise _unsupported(path, number, f"{model} with k4, k5 or k6")
        term = dict(zip(SUPPORTED[model].split(), p, strict=True))
        fx, fy = (term.get(key, p[0]) for key in ("fx", "fy"))
        radial = tuple(term.get(key, 0.0) for key in ("k1", "k2", "k3"))
        tangential = term.get("p1", 0.0), term.get("p2", 0.0)
        lens = Lens(width, height, (fx, fy), (term["cx"], term["cy"]), radial, tangential)
        if min(width, height) <= 0 or not np.isfinite(p).all():
            raise ValueError(f"camera {number}: invalid size {width}x{height} or parameters {p}")
        lenses[number] = checked(lens)
    return lenses


def read_images(path: Path) -> list[Registered]:
    """images.bin or images.txt; one of BROKEN where the file is broken."""
    if path.suffix == ".txt":
        rows = _images_text(path)
    else:
        found = image_records(path.read_bytes())
        rows = ((pose[:4], pose[4:], camera, name) for _, pose, camera, name, _ in found)
    images = []
    for quaternion, translation, camera, name in rows:
        largest = max(map(abs, quaternion))
        length = np.linalg.norm(quaternion) if largest < 2 else largest
        if not 0.5 < length < 2 or not np.abs(translation).max() <= FARTHEST:
            raise ValueError(f"the pose of {name} is invalid: {quaternion}, {translation}")
        to_camera = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
        position = -to_camera.T @ np.asarray(translation)
        pose = np.concatenate([to_camera.T @ TO_OPENGL, position[:, None]], 1)
        images.append(Registered(camera, name, pose))
    return images


def models_in(folder: Path, split: str) -> list[tuple[Path, str]]:
    """The models of the first place that has any: their folders and the ending of their files,
    binary ones first, as COLMAP does. That of the most photographs comes first: COLMAP numbers
    models as it begins them, and a first try may have ended with two photographs."""
    for place in PLACES:
        several = (folder / place).parent.glob("[0-9]*") if place.endswith("/0") else ()
        found = [
            (model, ending)
            for model in sorted({folder / place, *several}, key=lambda p: (len(p.name), p.name))
            if (ending := _ending(model))
        ]
        if found:
            return sorted(found, key=lambda one: -_count(one[0] / f"images{one[1]}"))
    return []


def _ending(model: Path) -> str | None:
    """The ending of a model's files; None if there is no model."""
    for ending in (".bin", ".txt"):
        if all((model / f"{name}{ending}").is_file() for name in ("cameras", "images")):
            return ending
    return None


def _count(images: Path) -> int:
    """Photographs of a model, about, without reading it."""
    with images.open("rb") as file:
        if images.suffix == ".bin":
            return int.from_bytes(file.read(8), "little")
        return sum(not line.startswith(b"#") for line in file) // 2


def _parameters(path: Path, number: int, model: str) -> int:
    """How many numbers a camera has."""
    if model not in SUPPORTED:
        raise _unsupported(path, number, model)
    return len(SUPPORTED[model].split())


def _unsupported(path: Path, number: int, model: str) -> DataError:
    return DataError(
        f"{path}: expected camera models {', '.join(SUPPORTED)}, got {model} for camera {number}: "
        "run colmap image_undistorter, or `univoxel poses` on the photographs"
    )


def _cameras_text(path: Path) -> Iterator[tuple[int, str, int, int, list[float]]]:
    for line in path.read_text(encoding="utf-8-sig").splitlines():
        if not line.strip() or line.startswith("#"):
            continue
        number, model, width, height, *rest = line.split()
        if len(rest) != _parameters(path, int(number), model):
            raise ValueError(f"camera {number}: {len(rest)} parameters do not fit model {model}")
        yield int(number), model, int(width), int(height), [float(value) for value in rest]


def _cameras_binary(path: Path) -> Iterator[tuple[int, str, int, int, list[float]]]:
    data = path.read_bytes()
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        number, kind, width, height = struct.unpack_from("<iiQQ", data, at)
        model = MODELS[kind] if 0 <= kind < len(MODELS) else f"model {kind}"
        form = f"<{_parameters(path, number, model)}d"
        at += 24
        yield number, model, width, height, list(struct.unpack_from(form, data, at))
        at += struct.calcsize(form)


def _images_text(path: Path) -> Iterator[tuple[list[float], list[float], int, str]]:
    lines = iter(path.read_text(encoding="utf-8-sig").splitlines())
    for line in lines:
        if not line.strip() or line.startswith("#"):
            continue
        _, *pose, camera, name = line.split(maxsplit=9)
        values = [float(value) for value in pose]
        if len(values) != 7:
            raise ValueError(f"expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got {line!r}")
        yield values[:4], values[4:], int(camera), name.strip()
        next(lines, None)  # its points, a line that may be empty


def image_records(data: bytes) -> Iterator[tuple[int, list[float], int, str, np.ndarray]]:
    """Of each photograph in images.bin: number, quaternion and translation to the camera, number of
    its camera, name, and its features as `SEEN`; one of BROKEN where the file is broken."""
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        number, *pose, camera = struct.unpack_from("<i7di", data, at)
        end = data.index(b"\0", at + 64)
        name = data[at + 64 : end].decode("utf-8")
        (features,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + features * SEEN.itemsize
        if at > len(data):
            raise ValueError("the file is truncated")
        yield number, pose, camera, name, np.frombuffer(data, SEEN, features, end + 9)
