"""Writes the model of structure from motion as a scene to train on."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from univoxel.capture.model import Model, Placed, write_model
from univoxel.capture.photographs import Photograph, fitted, read_upright
from univoxel.capture.prepare import Capture, read_mask
from univoxel.core.files import write_json
from univoxel.data.lens import Lens
from univoxel.data.load_images import turn_to_z, up_direction

DISTANCE = 4.0  # median distance of the cameras from the origin, in the written world
FLIP = np.array([1.0, -1.0, -1.0])  # camera axes of COLMAP to those of `Cameras`
QUALITY = 95  # of written JPEG
KEEP_PNG = (".png",)
REPORT = "poses.json"
WRITTEN = ("images", "masks", "sparse")  # folders of a scene
PARTIAL = ".partial"  # folder that they are written to at first


@dataclass(frozen=True)
class Report:
    """What is known of a photograph after the search for cameras."""

    name: str  # file of the photograph
    placed: bool
    points: int = 0  # of the model that it sees
    error: float = 0.0  # mean, pixels of the picture that features were sought in
    partners: int = 0  # photographs that it matches
    written: str = ""  # file in images/, where it is part of the scene
    reason: str = ""  # why it is not


def own_sizes(model: Model, capture: Capture, longest: int) -> Model:
    """The model for the pictures as they are written: portrait again, of their size, their names.

    One camera for each size of each camera; image ids stay.
    """
    index = {name: i for i, name in enumerate(capture.pictures)}
    cameras: dict[tuple[int, int, int], int] = {}
    lenses: dict[int, Lens] = {}
    images = []
    for image in model.images:
        photograph = capture.photographs[index[image.name]]
        width, height = fitted(photograph.width, photograph.height, longest)
        lens = model.cameras[image.camera]
        scale = max(width, height) / max(lens.width, lens.height)
        xy, to_camera, centre = image.xy, image.to_camera, lens.centre
        if photograph.portrait:
            xy = points_back(xy, lens.height)
            to_camera = to_camera_back(to_camera)
            centre = lens.height - centre[1], centre[0]
        camera = cameras.setdefault((image.camera, width, height), len(cameras) + 1)
        lenses[camera] = Lens(
            *(width, height),
            (lens.focal[0] * scale, lens.focal[1] * scale),
            (centre[0] * scale, centre[1] * scale),
            lens.radial,
        )
        name = written_name(photograph)
        images.append(Placed(image.number, camera, name, to_camera, xy * scale, image.point))
    return Model(lenses, images, model.points)


def points_back(points: np.ndarray, width: float) -> np.ndarray:
    """Pixel coordinates [..., 2] in the portrait picture of so many pixels across."""
    return np.stack([width - points[..., 1], points[..., 0]], -1)


def to_camera_back(to_camera: np.ndarray) -> np.ndarray:
    """World-to-camera [3, 3 or 4] of the portrait picture; axes x right, y down, z forward.

    The landscape picture's x axis is the portrait's y axis, and its y axis the opposite of x.
    """
    return np.stack([-to_camera[1], to_camera[0], to_camera[2]])


def gauge_aligned(model: Model) -> tuple[Model, bool]:
    """The model with +Z up, the origin where its cameras look, and its first camera at -Y.

    Of the similarity that structure from motion leaves open. Returns too whether the cameras say
    what is up; if not, the mean of their up directions is taken. Errors stay, they are in pixels.
    """
    axes = np.stack([i.to_camera[:, :3].T * FLIP for i in model.images])
    centres = np.stack([i.centre for i in model.images])
    up = up_direction(axes[:, :, :2].swapaxes(1, 2))
    known = up is not None
    if up is None:
        mean = axes[:, :, 1].mean(0)
        up = mean / np.linalg.norm(mean) if np.linalg.norm(mean) > 1e-6 else np.array([0, 0, 1.0])
    turn = turn_to_z(up)
    middle = looked_at(centres, -axes[:, :, 2])
    away = turn @ (centres - middle).T
    if np.hypot(*away[:2, 0]) > 1e-9:
        angle = -np.pi / 2 - np.arctan2(away[1, 0], away[0, 0])
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ turn
    distance = float(np.median(np.linalg.norm(away, axis=0)))
    scale = DISTANCE / distance if distance > 0 else 1.0
    shift = -scale * turn @ middle
    images = []
    for image in model.images:
        own = image.to_camera[:, :3] @ turn.T
        away = scale * image.to_camera[:, 3] - own @ shift
        images.append(replace(image, to_camera=np.concatenate([own, away[:, None]], 1)))
    points = replace(model.points, position=scale * model.points.position @ turn.T + shift)
    return Model(model.cameras, images, points), known


def looked_at(centres: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The point [3] nearest to all optical axes: positions [V, 3] and unit directions [V, 3]."""
    across = np.eye(3) - directions[:, :, None] * directions[:, None]
    system = across.mean(0) + 1e-9 * np.eye(3)
    return np.linalg.solve(system, (across @ centres[:, :, None]).mean(0)[:, 0])


def written_name(photograph: Photograph) -> str:
    """PNG stays PNG, all else becomes JPEG."""
    suffix = ".png" if photograph.path.suffix.lower() in KEEP_PNG else ".jpg"
    return f"{photograph.path.stem}{suffix}"


def write_scene(
    out: Path, capture: Capture, model: Model, wanted: list[int], longest: int
) -> Iterator[int]:
    """Write images/, masks/ and sparse/0 as a whole; yields how many photographs are written.

    Args:
        model: for the pictures as they are written.
        wanted: indices of the photographs to write.
        longest: pixels of the written pictures along the longer side, at most; 0 for any.
    """
    partial = out / PARTIAL
    shutil.rmtree(partial, ignore_errors=True)
    (partial / "images").mkdir(parents=True)
    for n, index in enumerate(wanted):
        photograph = capture.photographs[index]
        picture = read_upright(photograph.path, longest)
        name = written_name(photograph)
        if name.endswith(".png"):
            picture.save(partial / "images" / name)  # without EXIF, as it is not asked for
        else:
            flat = picture.convert("RGB")
            flat.save(partial / "images" / name, quality=QUALITY, subsampling=0)
        if capture.masks is not None:
            (partial / "masks").mkdir(exist_ok=True)
            mask = read_mask(capture, index).resize(picture.size)
            mask.save(partial / "masks" / f"{name}.png")
        yield n + 1
    write_model(partial / "sparse" / "0", model)
    for folder in WRITTEN:
        shutil.rmtree(out / folder, ignore_errors=True)
        if (partial / folder).exists():
            (partial / folder).rename(out / folder)
    partial.rmdir()


def write_report(out: Path, settings: dict[str, Any], model: Model, reports: list[Report]) -> None:
    """Write poses.json: how the cameras were found, and what is known of each photograph."""
    cameras = {
        str(number): {
            "width": lens.width,
            "height": lens.height,
            "focal": lens.focal[0],
            "radial": lens.radial[0],
        }
        for number, lens in model.cameras.items()
    }
    record = {
        **settings,
        "placed": sum(r.placed for r in reports),
        "error": model.error,
        "cameras": cameras,
        "photographs": [vars(r) for r in reports],
    }
    write_json(out / REPORT, record)
