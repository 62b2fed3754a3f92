"""Cameras that Metashape exported, as XML.

cameras.xml                 or any other name.xml: chunk with sensors (resolution, calibration: f,
                            cx, cy, b1, b2, k1 to k4, p1, p2), components and cameras (label,
                            sensor_id, component_id, transform)
images/<label>              photographs, or in the folder itself, of any ending
masks/<label>.png           masks, also masks/<label>_mask.png, or alpha in the photographs

A camera's transform is camera-to-world, axes x right, y down, z forward, in its component or chunk,
whose own transform (rotation, translation, scale) leads to the world. cx and cy are counted from
the picture's middle. p1 and p2 are those of OpenCV the other way round.

Source: Agisoft Metashape User Manual, "Camera models".
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from univoxel.data.base import Photos
from univoxel.data.foreign import TO_OPENGL, check_skew, find_photo, parsed
from univoxel.data.inside import inside
from univoxel.data.lens import Lens, fitted
from univoxel.data.missing import left_out
from univoxel.data.shots import Shot, every_eighth, read_shots, upright
from univoxel.data.transforms import lens_of, pose_of, short
from univoxel.errors import DataError

HEAD = 4096  # bytes of a file in which <document> and <chunk> stand
OFF = ("0", "false", "False")  # as the attribute enabled of a camera
TERMS = ("k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4", "b1", "b2", "cx", "cy")


def is_metashape(folder: Path, split: str) -> bool:
    return _file(folder) is not None


def load_metashape(
    folder: Path, split: str = "train", downscale: int = 0, masks: bool | Path = True
) -> Photos:
    """Photographs and cameras of one split: every eighth is for tests.

    The world keeps its scale, and is turned so that +Z is up; it keeps its origin, too, unless that
    is far away. Of several components the one with most cameras is read.

    Raises:
        DataError: one line that names the file, what was expected and what came.
    """
    path = _file(folder) or folder / "cameras.xml"
    chunk = _chunk(path)
    sensors = {s.get("id"): s for s in chunk.iterfind("sensors/sensor")}
    every = list(chunk.iterfind("cameras//camera"))
    placed = [c for c in every if c.find("transform") is not None and c.get("enabled") not in OFF]
    if not placed:
        raise DataError(f"{path}: expected cameras with a transform, got {len(every)} without")
    component, _ = Counter(c.get("component_id") for c in placed).most_common(1)[0]
    chosen = [c for c in placed if c.get("component_id") == component]
    world = _world(chunk, component, path)

    groups = {c: g.get("label") for g in chunk.iterfind("cameras/group") for c in g.iter("camera")}
    twice = Counter(c.get("label") for c in chosen)
    lenses: dict[str | None, Lens] = {}
    shots, missing = [], []
    for camera in chosen:
        label, sensor = camera.get("label") or "", camera.get("sensor_id")
        where = f"{path}: camera {label}"
        group = groups.get(camera) if twice[label] > 1 else None
        listed = f"{group}/{label}" if group else label
        picture = find_photo(folder, listed, where) if label else None
        if picture is None:
            missing.append(listed)
            continue
        if sensor not in lenses:
            lenses[sensor] = _lens(sensors.get(sensor), f"{path}: sensor {sensor} of {label}")
        pose = _pose(camera, world, where)
        lens = fitted(lenses[sensor], picture, where)
        name = f"{group}_{picture.stem}" if group else picture.stem
        shots.append(Shot(name, where, picture, None, pose, lens))
    note = f" (looked in {folder / 'images'} and {folder})"
    lost = left_out(str(path), missing, len(chosen), note)
    if len(every) > len(chosen):
        told = "not placed, not enabled or in another component"
        if rig := sum(c.get("master_id") is not None for c in every if c not in placed):
            told += f"; {rig} of a rig, whose place is that of a master camera"
        lost += [f"{len(every) - len(chosen)} of {len(every)} cameras left out: {told}"]
    shots, remarks = upright(shots)
    shots = every_eighth(folder, shots, split)
    remarks = [*lost, *remarks]
    return read_shots(folder, "Metashape cameras", split, shots, downscale, remarks, masks)


def _file(folder: Path) -> Path | None:
    for path in sorted(folder.glob("*.xml")):
        if path.is_file():
            with path.open("rb") as stream:
                head = stream.read(HEAD)
            if b"<document" in head and b"<chunk" in head:
                return path
    return None


def _chunk(path: Path) -> ET.Element:
    data = inside(path, str(path)).read_bytes()
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:  # which may grow without bound
        raise DataError(f"{path}: expected XML of Metashape, got one with definitions of its own")
    try:
        root = ET.fromstring(data)
    except ET.ParseError as error:
        raise DataError(f"{path}: expected XML, could not read it: {error}") from None
    chunks = root.findall("chunk")
    if len(chunks) != 1:
        raise DataError(f"{path}: expected one chunk, got {len(chunks)}")
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


def _pose(camera: ET.Element, world: tuple[float, np.ndarray], where: str) -> np.ndarray:
    matrix = _numbers(camera.find("transform"), 16, "transform", where).reshape(4, 4)
    local, (scale, outer) = pose_of(matrix, where), world
    turn, shift = outer[:, :3], outer[:, 3]
    return np.column_stack([turn @ local[:, :3] @ TO_OPENGL, scale * turn @ local[:, 3] + shift])


def _lens(sensor: ET.Element | None, where: str) -> Lens:
    """The lens of a sensor, in the terms of OpenCV."""
    if sensor is None:
        raise DataError(f"{where}: expected it among the sensors, got none")
    if (kind := sensor.get("type", "frame")) != "frame":
        raise DataError(f"{where}: expected a sensor of type frame, got {kind}")
    calibrations = sensor.findall("calibration")
    adjusted = [c for c in calibrations if c.get("class", "adjusted") == "adjusted"]
    if not calibrations:
        raise DataError(f"{where}: expected a calibration, got none")
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
        raise DataError(f"{where}: expected distortion by k1 to k4, p1 and p2, got p3 or p4 too")
    values = {"fl_x": focal + term["b1"], "fl_y": focal}
    values |= {"cx": width / 2 + term["cx"], "cy": height / 2 + term["cy"]}
    values |= {"p1": term["p2"], "p2": term["p1"]}
    values |= {key: term[key] for key in ("k1", "k2", "k3")}
    lens = lens_of(values, where, width, height)
    check_skew(term["b2"], lens, where)
    return replace(lens, radial=(*lens.radial, term["k4"]))
