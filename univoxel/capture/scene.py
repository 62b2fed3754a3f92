"""From the model of structure from motion to a scene that training reads."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image

from univoxel.capture.model import Model, Placed, write_model
from univoxel.capture.photographs import Photograph, fitted, read_upright
from univoxel.capture.prepare import Capture, read_mask
from univoxel.capture.turning import points_back, to_camera_back
from univoxel.data.lens import Lens
from univoxel.files import replacing

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
        _write(picture, partial / "images" / name)
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
    with replacing(out / REPORT) as temporary:
        temporary.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def _write(picture: Image.Image, path: Path) -> None:
    if path.suffix == ".png":
        picture.save(path)  # without EXIF, as it is not asked for
    else:
        picture.convert("RGB").save(path, quality=QUALITY, subsampling=0)
