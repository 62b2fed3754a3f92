"""Cameras that photogrammetry programs export: Metashape, RealityCapture, Polycam.

docs/reference/data-sets.md lists the files of each.
"""

from __future__ import annotations

import codecs
import csv
import math
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from itertools import starmap
from pathlib import Path, PureWindowsPath

import numpy as np
from scipy.spatial.transform import Rotation

from univoxel.core.files import read_json
from univoxel.data.images import image_size, turn_note
from univoxel.data.lens import Lens, fitted
from univoxel.data.load_images import (
    Listed,
    Shot,
    every_eighth,
    in_moved_world,
    present,
    turned_up,
)
from univoxel.data.path_sandbox import inside
from univoxel.data.transforms import (
    TO_OPENGL,
    check_skew,
    find_photo,
    lens_of,
    listed_image,
    looked_in,
    parsed,
    pose_of,
    read_number,
    short,
)
from univoxel.errors import DataError

HEAD = 4096  # bytes of a file that say what it is


def _first(folder: Path, pattern: str, fits: Callable[[bytes], bool]) -> Path | None:
    """The first file of a folder by name whose beginning fits."""
    for path in sorted(folder.glob(pattern)):
        if path.is_file():
            with path.open("rb") as stream:
                if fits(stream.read(HEAD)):
                    return path
    return None


def _lens(
    where: str, size: tuple[int, int], values: dict[str, float], term: dict[str, float], note=""
) -> Lens:
    """A lens of the terms k1 to k4, in the words of `lens_of`."""
    lens = lens_of(values | {key: term[key] for key in ("k1", "k2", "k3")}, where, *size, note)
    return replace(lens, radial=(*lens.radial, term["k4"]))


# Cameras that Metashape exported, as XML.
#
# A camera's transform is camera-to-world, axes x right, y down, z forward, in its component or
# chunk, whose own transform (rotation, translation, scale) leads to the world. cx and cy are
# counted from the picture's middle. p1 and p2 are those of OpenCV the other way round.
#
# Source: Agisoft Metashape User Manual, "Camera models".


OFF = ("0", "false", "False")  # as the attribute enabled of a camera
TERMS = ("k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4", "b1", "b2", "cx", "cy")


def list_metashape(folder: Path, split: str, path: Path) -> Listed:
    """Of several components the one with most cameras is read."""
    chunk = _chunk(path)
    sensors = {s.get("id"): s for s in chunk.iterfind("sensors/sensor")}
    every = list(chunk.iterfind("cameras//camera"))
    placed = [c for c in every if c.find("transform") is not None and c.get("enabled") not in OFF]
    if not placed:
        raise DataError(f"{path}: none of the {len(every)} cameras is both aligned and enabled")
    component, _ = Counter(c.get("component_id") for c in placed).most_common(1)[0]
    chosen = [c for c in placed if c.get("component_id") == component]
    world = _world(chunk, component, path)

    groups = {c: g.get("label") for g in chunk.iterfind("cameras/group") for c in g.iter("camera")}
    twice = Counter(c.get("label") for c in chosen)
    lenses: dict[str | None, Lens] = {}

    def shot(camera: ET.Element) -> Shot | str:
        label, sensor = camera.get("label") or "", camera.get("sensor_id")
        where = f"{path}: camera {label}"
        group = groups.get(camera) if twice[label] > 1 else None
        listed = f"{group}/{label}" if group else label
        picture = find_photo(folder, listed, where) if label else None
        if picture is None:
            return listed
        if sensor not in lenses:
            lenses[sensor] = _sensor_lens(
                sensors.get(sensor), f"{path}: sensor {sensor} of camera {label}"
            )
        pose = _camera_pose(camera, world, where)
        lens = fitted(lenses[sensor], picture, where)
        name = f"{group}_{picture.stem}" if group else picture.stem
        return Shot(name, where, picture, None, pose, lens)

    shots, lost = present(path, map(shot, chosen), looked_in(folder))
    if len(every) > len(chosen):
        told = "not placed, not enabled or in another component"
        if rig := sum(c.get("master_id") is not None for c in every if c not in placed):
            told += f"; {rig} belong to a rig, of which only the master camera has a pose"
        lost.append(f"{len(every) - len(chosen)} of {len(every)} cameras left out: {told}")
    return turned_up(folder, split, "Metashape cameras", shots, lost)


def metashape_file(folder: Path, split: str) -> Path | None:
    return _first(folder, "*.xml", lambda head: b"<document" in head and b"<chunk" in head)


def _chunk(path: Path) -> ET.Element:
    data = inside(path, str(path)).read_bytes()
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:  # which may grow without bound
        raise DataError(f"{path}: expected Metashape XML, got XML with a DOCTYPE or ENTITY")
    try:
        root = ET.fromstring(data)
    except ET.ParseError as error:
        raise DataError(f"{path}: this XML could not be read: {error}") from None
    chunks = root.findall("chunk")
    if len(chunks) != 1:
        raise DataError(f"{path}: expected one chunk, got {len(chunks)}: export only one")
    return chunks[0]


def _numbers(element: ET.Element | None, count: int, what: str, where: str) -> np.ndarray:
    text = None if element is None else element.text
    values = [parsed(word, what, where) for word in (text or "").split()]
    if len(values) != count:
        came = "nothing" if text is None else short(text)
        raise DataError(f"{where}: expected {count} numbers as {what}, got {came}")
    return np.array(values)


def _world(chunk: ET.Element, component: str | None, path: Path) -> tuple[float, np.ndarray]:
    """Scale, and [3, 4] rotation and translation, from a component to the world."""
    found = chunk.iterfind("components/component")
    named = next((c for c in found if c.get("id") == component), None)
    transform = None if named is None else named.find("transform")
    where = f"{path}: transform of " + ("chunk" if transform is None else f"component {component}")
    transform = chunk.find("transform") if transform is None else transform
    if transform is None or transform.find("rotation") is None:
        return 1.0, np.eye(3, 4)
    rotation = _numbers(transform.find("rotation"), 9, "rotation", where).reshape(3, 3)
    translation = _numbers(transform.find("translation"), 3, "translation", where)
    scale = _numbers(transform.find("scale"), 1, "scale", where)[0]
    if scale <= 0:
        raise DataError(f"{where}: expected a scale above 0, got {scale:g}")
    return float(scale), pose_of(np.column_stack([rotation, translation]), where)


def _camera_pose(camera: ET.Element, world: tuple[float, np.ndarray], where: str) -> np.ndarray:
    matrix = _numbers(camera.find("transform"), 16, "transform", where).reshape(4, 4)
    local, (scale, outer) = pose_of(matrix, where), world
    turn, shift = outer[:, :3], outer[:, 3]
    return np.column_stack([turn @ local[:, :3] @ TO_OPENGL, scale * turn @ local[:, 3] + shift])


def _sensor_lens(sensor: ET.Element | None, where: str) -> Lens:
    """The lens of a sensor, in the terms of OpenCV."""
    if sensor is None:
        raise DataError(f"{where}: this sensor is not listed in the file")
    if (kind := sensor.get("type", "frame")) != "frame":
        raise DataError(f"{where}: expected a sensor of type frame, got {kind}")
    calibrations = sensor.findall("calibration")
    adjusted = [c for c in calibrations if c.get("class", "adjusted") == "adjusted"]
    if not calibrations:
        raise DataError(f"{where}: expected a calibration, found none")
    calibration = (adjusted or calibrations)[0]
    resolution = calibration.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    size = {} if resolution is None else resolution.attrib
    width, height = (int(parsed(size.get(key), key, where)) for key in ("width", "height"))
    if min(width, height) < 1:
        raise DataError(f"{where}: expected a resolution above 0, got {width}x{height}")
    focal = parsed(calibration.findtext("f"), "f", where)
    term = {key: parsed(calibration.findtext(key, "0"), key, where) for key in TERMS}
    if term["p3"] or term["p4"]:
        raise DataError(f"{where}: expected distortion terms k1 to k4, p1 and p2, got p3 or p4")
    values = {"fl_x": focal + term["b1"], "fl_y": focal}
    values |= {"cx": width / 2 + term["cx"], "cy": height / 2 + term["cy"]}
    values |= {"p1": term["p2"], "p2": term["p1"]}
    lens = _lens(where, (width, height), values, term)
    check_skew(term["b2"], lens, where)
    return lens


# Cameras that RealityCapture or RealityScan exported as "Internal/External camera parameters".
#
# x, y, alt is the camera's place in a world with +Z up. Angles are in degrees: with all at 0 a
# camera looks down, and its picture's top is at +Y; it is turned by -heading about z, pitch about x
# and roll about y. f is of film 36 mm wide, which is the picture's longer side; px and py are how
# far the principal point is from the middle, in longer sides. t1 and t2 are OpenCV's p2 and p1.
#
# Source: the vendor's "Registration export and camera orientations" and "XMP Camera Math".


DELIMITERS = (",", ";", "\t")
FILM = 36  # millimetres along the longer side that focal lengths are for
REQUIRED = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
# Of RealityScan 2.2 and on
OTHER_NAMES = {"yaw": "heading", "f_35mm": "f", "px_norm": "px", "py_norm": "py"}


def list_realitycapture(folder: Path, split: str, path: Path) -> Listed:
    def shot(line: int, row: dict[str, str]) -> Shot | str:
        where = f"{path}: line {line}"
        name = PureWindowsPath(row.get("name") or "").name
        picture = find_photo(folder, name, where) if name else None
        if picture is None:
            return name or where
        lens, pose = _row_lens(row, picture, where), _row_pose(row, where)
        return Shot(picture.stem, where, picture, None, pose, lens)

    shots, lost = present(path, starmap(shot, _rows(path)), looked_in(folder))
    return turned_up(folder, split, "RealityCapture cameras", shots, lost)


def realitycapture_file(folder: Path, split: str) -> Path | None:
    def fits(head: bytes) -> bool:
        return any(map(_delimiter, _text(head, "replace").splitlines()[:2]))

    return _first(folder, "*.csv", fits)


def _text(data: bytes, errors: str = "strict") -> str:
    """Text in UTF-8, or in UTF-16, as spreadsheets write it."""
    wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return data.decode("utf-16" if wide else "utf-8-sig", errors)


def _delimiter(line: str) -> str | None:
    """What stands between the names of the columns; None if it is no line of them."""
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


def _row_lens(row: dict[str, str], picture: Path, where: str) -> Lens:
    width, height = image_size(picture)
    side = max(width, height)
    keys = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
    term = {key: parsed(row.get(key, "0"), key, where) for key in keys}
    focal = parsed(row["f"], "f", where) * side / FILM
    values = {"fl_x": focal, "cx": width / 2 + side * term["px"]}
    values |= {"cy": height / 2 + side * term["py"], "p1": term["t2"], "p2": term["t1"]}
    return _lens(where, (width, height), values, term, turn_note(picture))


def _row_pose(row: dict[str, str], where: str) -> np.ndarray:
    place = [parsed(row[key], key, where) for key in ("x", "y", "alt")]
    heading, pitch, roll = (parsed(row[key], key, where) for key in ("heading", "pitch", "roll"))
    turn = Rotation.from_euler("ZXY", [-heading, pitch, roll], degrees=True).as_matrix()
    return pose_of(np.column_stack([turn, place]), where)


# Polycam's raw data, as its developer mode exports them.
#
# ARKit's camera axes are x right, y up, z backwards, of the picture as it is stored, and its world
# has +Y up.
#
# Source: nerfstudio's documentation of its converter for Polycam; Apple's of ARCamera.transform.


# Where cameras and images are; what loops were closed in comes first
PLACES = ("keyframes/corrected_", "keyframes/", "corrected_")
UPRIGHT = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0]])  # from +Y up to +Z up


def list_polycam(folder: Path, split: str, place: str) -> Listed:
    """The world keeps its scale, metres, and its origin, and is turned from +Y up to +Z up."""
    cameras, pictures = folder / f"{place}cameras", folder / f"{place}images"

    def shot(path: Path) -> Shot | str:
        picture = listed_image(pictures, path.stem, str(path))
        if picture is None:
            return path.stem
        values = _read(path)
        width, height = (int(values[key]) for key in ("width", "height"))
        lens = fitted(lens_of(values, str(path), width, height), picture, str(path))
        pose = pose_of(values["pose"], str(path))
        return Shot(path.stem, str(path), picture, None, pose, lens)

    note = f" (looked in {pictures}"
    others = folder / f"{place.removesuffix('corrected_')}images"
    if others != pictures and others.is_dir():
        note += f"; the images in {others} belong to the cameras in {others.with_name('cameras')}"
    shots, lost = present(cameras, map(shot, sorted(cameras.glob("*.json"))), f"{note})")
    shots = every_eighth(folder, in_moved_world(shots, UPRIGHT), split)
    return Listed("Polycam raw data", shots, [*lost, "world rotated so that +Z is up (was +Y)"])


def polycam_place(folder: Path, split: str) -> str | None:
    return next((p for p in PLACES if any((folder / f"{p}cameras").glob("*.json"))), None)


def _read(path: Path) -> dict:
    """Intrinsics in the words of `lens_of`, width, height and the pose [3, 4]."""
    root = read_json(inside(path, str(path)))
    if not isinstance(root, dict):
        raise DataError(f"{path}: expected a JSON object, got {short(root)}")

    def number(key: str, low: float = -math.inf) -> float:
        return read_number(root, key, str(path), low, math.inf)

    found = {key: number(key, low=0) for key in ("width", "height")}
    found |= {"fl_x": number("fx"), "fl_y": number("fy"), "cx": number("cx"), "cy": number("cy")}
    pose = [[number(f"t_{row}{column}") for column in range(4)] for row in range(3)]
    return {**found, "pose": pose}
