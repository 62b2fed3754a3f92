"""Cameras that RealityCapture or RealityScan exported as "Internal/External camera parameters".

cameras.csv                 or any other name.csv, with the columns name, x, y, alt, heading, pitch,
                            roll, f, and perhaps px, py, k1 to k4, t1, t2
images/<name>               photographs, or in the folder itself
masks/<name>.png            masks, or alpha in the photographs

x, y, alt is the camera's place in a world with +Z up. Angles are in degrees: with all at 0 a camera
looks down, and its picture's top is at +Y; it is turned by -heading about z, pitch about x and roll
about y. f is of film 36 mm wide, which is the picture's longer side; px and py are how far the
principal point is from the middle, in longer sides. t1 and t2 are OpenCV's p2 and p1.

Source: the vendor's "Registration export and camera orientations" and "XMP Camera Math".
"""

from __future__ import annotations

import codecs
import csv
from dataclasses import replace
from pathlib import Path, PureWindowsPath

import numpy as np
from scipy.spatial.transform import Rotation

from univoxel.data.base import Photos
from univoxel.data.foreign import find_photo, parsed
from univoxel.data.images import image_size, turn_note
from univoxel.data.inside import inside
from univoxel.data.lens import Lens
from univoxel.data.missing import left_out
from univoxel.data.shots import Shot, every_eighth, read_shots, upright
from univoxel.data.transforms import lens_of, pose_of
from univoxel.errors import DataError

HEAD = 4096  # bytes of a file in which the names of columns stand
DELIMITERS = (",", ";", "\t")
FILM = 36  # millimetres along the longer side that focal lengths are for
REQUIRED = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
# Of RealityScan 2.2 and on
OTHER_NAMES = {"yaw": "heading", "f_35mm": "f", "px_norm": "px", "py_norm": "py"}


def is_realitycapture(folder: Path, split: str) -> bool:
    return _file(folder) is not None


def load_realitycapture(
    folder: Path, split: str = "train", downscale: int = 0, masks: bool | Path = True
) -> Photos:
    """Photographs and cameras of one split: every eighth is for tests.

    The world keeps its scale, and is turned so that +Z is up, where it is not yet; it keeps its
    origin, too, unless that is far away.

    Raises:
        DataError: one line that names the file, what was expected and what came.
    """
    path = _file(folder) or folder / "cameras.csv"
    rows = _rows(path)
    shots, missing = [], []
    for line, row in rows:
        where = f"{path}: line {line}"
        name = PureWindowsPath(row.get("name") or "").name
        picture = find_photo(folder, name, where) if name else None
        if picture is None:
            missing.append(name or where)
            continue
        lens, pose = _lens(row, picture, where), _pose(row, where)
        shots.append(Shot(picture.stem, where, picture, None, pose, lens))
    note = f" (looked in {folder / 'images'} and {folder})"
    lost = left_out(str(path), missing, len(rows), note)
    shots, remarks = upright(shots)
    shots = every_eighth(folder, shots, split)
    remarks = [*lost, *remarks]
    return read_shots(folder, "RealityCapture cameras", split, shots, downscale, remarks, masks)


def _file(folder: Path) -> Path | None:
    for path in sorted(folder.glob("*.csv")):
        if path.is_file():
            with path.open("rb") as stream:
                head = _text(stream.read(HEAD), "replace")
            if any(_delimiter(line) for line in head.splitlines()[:2]):
                return path
    return None


def _text(data: bytes, errors: str = "strict") -> str:
    """Text in UTF-8, or in UTF-16, as spreadsheets write it."""
    wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return data.decode("utf-16" if wide else "utf-8-sig", errors)


def _delimiter(line: str) -> str | None:
    """What stands between the names of the columns; None where it is no line of them."""
    return next((d for d in DELIMITERS if set(REQUIRED) <= set(_columns(line, d))), None)


def _columns(line: str, delimiter: str) -> list[str]:
    names = [name.strip().lstrip("#").strip().lower() for name in line.split(delimiter)]
    return [OTHER_NAMES.get(name, name) for name in names]


def _rows(path: Path) -> list[tuple[int, dict[str, str]]]:
    """Rows by the names of their columns, each with the number of its line."""
    try:
        lines = _text(inside(path, str(path)).read_bytes()).splitlines()
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: expected text in UTF-8, got {error.reason}") from None
    start, delimiter = next((i, d) for i, line in enumerate(lines) if (d := _delimiter(line)))
    columns, rows = _columns(lines[start], delimiter), []
    for number, line in enumerate(lines[start + 1 :], start + 2):
        if not line.strip() or line.startswith("#"):
            continue
        values = next(csv.reader([line], delimiter=delimiter))
        if len(values) != len(columns):
            raise DataError(
                f"{path}: line {number}: expected {len(columns)} values, got {len(values)}"
            )
        row = dict(zip(columns, values, strict=True))
        if delimiter != ",":  # where the comma is that of numbers
            row |= {key: v.replace(",", ".") for key, v in row.items() if key != "name"}
        rows.append((number, row))
    if not rows:
        raise DataError(f"{path}: expected a line for each camera, got none")
    return rows


def _lens(row: dict[str, str], picture: Path, where: str) -> Lens:
    width, height = image_size(picture)
    side = max(width, height)
    keys = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
    term = {key: parsed(row.get(key, "0"), key, where) for key in keys}
    focal = parsed(row["f"], "f", where) * side / FILM
    values = {"fl_x": focal, "cx": width / 2 + side * term["px"]}
    values |= {"cy": height / 2 + side * term["py"], "p1": term["t2"], "p2": term["t1"]}
    values |= {key: term[key] for key in ("k1", "k2", "k3")}
    lens = lens_of(values, where, width, height, turn_note(picture))
    return replace(lens, radial=(*lens.radial, term["k4"]))


def _pose(row: dict[str, str], where: str) -> np.ndarray:
    place = [parsed(row[key], key, where) for key in ("x", "y", "alt")]
    heading, pitch, roll = (parsed(row[key], key, where) for key in ("heading", "pitch", "roll"))
    turn = Rotation.from_euler("ZXY", [-heading, pitch, roll], degrees=True).as_matrix()
    return pose_of(np.column_stack([turn, place]), where)
