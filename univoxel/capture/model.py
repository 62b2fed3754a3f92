"""COLMAP's files: the database of features and matches, and models with their points."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from univoxel.core.files import write_bytes
from univoxel.data.colmap import SEEN, image_records, read_cameras
from univoxel.data.lens import Lens

# COLMAP's database of features and matches, read in this process: it is SQLite.
#
# Source: COLMAP's documentation, "Database Format".


MOST_IMAGES = 2147483647  # what pair ids are made with
WATERMARK = 7  # configuration of a pair whose match is a shift only, near the pictures' border


@dataclass(frozen=True)
class Pair:
    """Two pictures with matches that were verified."""

    first: int  # image ids
    second: int
    matches: np.ndarray  # [M, 2] which feature of the first and of the second
    kind: int  # configuration


def _rows(path: Path, query: str, *values: int) -> Iterator[tuple[Any, ...]]:
    with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as db:
        yield from db.execute(query, values)


def count(path: Path, table: str) -> int:
    """Rows of a table, 0 as long as it is not there."""
    try:
        return sum(n for (n,) in _rows(path, f"SELECT COUNT(*) FROM {table}"))
    except sqlite3.OperationalError:  # not made yet, or locked
        return 0


def images(path: Path) -> dict[str, tuple[int, int]]:
    """Id and camera of each picture, by name; none as long as they are not there."""
    try:
        rows = list(_rows(path, "SELECT name, image_id, camera_id FROM images"))
    except sqlite3.OperationalError:
        return {}
    return {name: (number, camera) for name, number, camera in rows}


def feature_counts(path: Path) -> dict[int, int]:
    """Number of features by image id."""
    return dict(_rows(path, "SELECT image_id, rows FROM keypoints"))


def largest_features(path: Path, image: int, most: int) -> np.ndarray:
    """Unit descriptors [N, D] float32 of the features of largest scale."""
    query = "SELECT rows, cols, data FROM {} WHERE image_id = ?"
    points = next(_rows(path, query.format("keypoints"), image), None)
    described = next(_rows(path, query.format("descriptors"), image), None)
    if points is None or described is None or not points[0]:
        return np.zeros((0, 128), np.float32)
    points = np.frombuffer(points[2], np.float32).reshape(points[0], points[1])
    # x, y, scale, angle; or x, y and a 2x2 matrix
    scale = points[:, 2] if points.shape[1] < 6 else np.hypot(points[:, 2], points[:, 4])
    descriptors = np.frombuffer(described[2], np.uint8).reshape(described[0], -1)
    chosen = np.argsort(-scale, kind="stable")[:most]
    found = descriptors[chosen].astype(np.float32)
    return found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-9)


def verified_pairs(path: Path) -> list[tuple[int, int, int, int]]:
    """Image ids, inliers and configuration of each pair that was verified."""
    rows = _rows(path, "SELECT pair_id, rows, config FROM two_view_geometries")
    return [(pair // MOST_IMAGES, pair % MOST_IMAGES, n, kind) for pair, n, kind in rows]


def matches(path: Path) -> Iterator[Pair]:
    """Pairs that were verified, with their inliers."""
    query = "SELECT pair_id, rows, data, config FROM two_view_geometries WHERE rows > 0"
    for pair, rows, data, kind in _rows(path, query):
        found = np.frombuffer(data, np.uint32).reshape(rows, 2)
        yield Pair(pair // MOST_IMAGES, pair % MOST_IMAGES, found, kind)


def positions(path: Path) -> dict[int, np.ndarray]:
    """Where features are [F, 2], pixels, by image id."""
    return {
        number: np.frombuffer(data or b"", np.float32).reshape(count, width)[:, :2].astype(float)
        for number, count, width, data in _rows(
            path, "SELECT image_id, rows, cols, data FROM keypoints"
        )
    }


# Models of COLMAP with their points, read and written whole.
#
# `univoxel.data.colmap` reads cameras and poses only, of any model; here are tracks as well.
# Source: COLMAP's documentation, "Output Format", binary.


SIMPLE_RADIAL = 2  # its number in the files
NO_POINT = -1
TRACK = np.dtype([("image", "<i4"), ("index", "<i4")])


@dataclass(frozen=True)
class Placed:
    """A picture with its pose and what it sees."""

    number: int  # id in model and database
    camera: int
    name: str
    to_camera: np.ndarray  # [3, 4] world-to-camera; x right, y down, z forward
    xy: np.ndarray  # [F, 2] features, pixels
    point: np.ndarray  # [F] id of the point that each shows, or NO_POINT

    @property
    def points(self) -> int:
        """How many points of the model it sees."""
        return int((self.point != NO_POINT).sum())

    @property
    def centre(self) -> np.ndarray:
        """Where the camera stands [3]."""
        return -self.to_camera[:, :3].T @ self.to_camera[:, 3]


@dataclass(frozen=True)
class Points:
    """Points that several pictures show."""

    number: np.ndarray  # [P] int64
    position: np.ndarray  # [P, 3]
    color: np.ndarray  # [P, 3] uint8
    error: np.ndarray  # [P] mean reprojection error, pixels
    tracks: list[np.ndarray]  # P of [N] TRACK: which feature of which picture


@dataclass(frozen=True)
class Model:
    cameras: dict[int, Lens]
    images: list[Placed]
    points: Points

    @property
    def error(self) -> float:
        """Mean reprojection error over all observations, pixels."""
        weight = np.array([len(t) for t in self.points.tracks], float)
        return float(self.points.error @ weight / max(weight.sum(), 1))

    def errors(self) -> dict[int, float]:
        """Mean error of the points that each image sees, pixels."""
        found = dict(zip(self.points.number.tolist(), self.points.error.tolist(), strict=True))
        seen = {i.number: [found[p] for p in i.point.tolist() if p in found] for i in self.images}
        return {number: float(np.mean(e)) if e else 0.0 for number, e in seen.items()}


def read_models(folder: Path) -> list[Model]:
    """All models below a folder, the largest first: the first that COLMAP makes may be a decoy."""
    places = [p for p in sorted(folder.glob("*")) if (p / "images.bin").is_file()]
    return sorted((read_model(p) for p in places), key=lambda m: -len(m.images))


def read_model(folder: Path) -> Model:
    images = _read_images((folder / "images.bin").read_bytes())
    points = _read_points((folder / "points3D.bin").read_bytes())
    return Model(read_cameras(folder / "cameras.bin"), images, points)


def write_model(folder: Path, model: Model) -> None:
    """Write cameras, all SIMPLE_RADIAL, images and points."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in (
        ("cameras.bin", _cameras(model.cameras)),
        ("images.bin", _images(model.images)),
        ("points3D.bin", _points(model.points)),
    ):
        write_bytes(folder / name, data)


def without(model: Model, numbers: set[int]) -> Model:
    """The model without some images, and without points that fewer than two others show."""
    images = [i for i in model.images if i.number not in numbers]
    p = model.points
    tracks = [t[~np.isin(t["image"], list(numbers))] for t in p.tracks]
    some = np.array([len(np.unique(t["image"])) >= 2 for t in tracks], bool)
    tracks = list(compress(tracks, some))
    points = Points(p.number[some], p.position[some], p.color[some], p.error[some], tracks)
    images = [
        replace(i, point=np.where(np.isin(i.point, points.number), i.point, NO_POINT))
        for i in images
    ]
    return Model(model.cameras, images, points)


def _read_images(data: bytes) -> list[Placed]:
    found = []
    for number, pose, camera, name, seen in image_records(data):
        turn = Rotation.from_quat(pose[:4], scalar_first=True).as_matrix()
        to_camera = np.concatenate([turn, np.array(pose[4:])[:, None]], 1)
        found.append(Placed(number, camera, name, to_camera, seen["xy"], seen["point"]))
    return found


def _read_points(data: bytes) -> Points:
    (count,), at = struct.unpack_from("<Q", data), 8
    rows, tracks = [], []
    for _ in range(count):
        *row, length = struct.unpack_from("<q3d3BdQ", data, at)
        at += struct.calcsize("<q3d3BdQ")
        rows.append(row)
        tracks.append(np.frombuffer(data, TRACK, length, at))
        at += length * TRACK.itemsize
    table = np.array(rows, float).reshape(-1, 8)
    number = np.array([row[0] for row in rows], np.int64)
    return Points(number, table[:, 1:4], table[:, 4:7].astype(np.uint8), table[:, 7], tracks)


def _cameras(cameras: Mapping[int, Lens]) -> bytes:
    data = struct.pack("<Q", len(cameras))
    for number, lens in sorted(cameras.items()):
        values = (lens.focal[0], *lens.centre, lens.radial[0])
        data += struct.pack("<iiQQ4d", number, SIMPLE_RADIAL, lens.width, lens.height, *values)
    return data


def _images(images: Sequence[Placed]) -> bytes:
    parts = [struct.pack("<Q", len(images))]
    for image in images:
        turn = Rotation.from_matrix(image.to_camera[:, :3]).as_quat(scalar_first=True)
        parts.append(
            struct.pack("<i7di", image.number, *turn, *image.to_camera[:, 3], image.camera)
        )
        seen = np.zeros(len(image.point), SEEN)
        seen["xy"], seen["point"] = image.xy, image.point
        parts += [image.name.encode(), b"\0", struct.pack("<Q", len(seen)), seen.tobytes()]
    return b"".join(parts)


def _points(points: Points) -> bytes:
    parts = [struct.pack("<Q", len(points.number))]
    for number, position, color, error, track in zip(
        *(points.number, points.position, points.color, points.error, points.tracks), strict=True
    ):
        row = struct.pack("<q3d3BdQ", int(number), *position, *color.tolist(), error, len(track))
        parts += [row, np.ascontiguousarray(track).tobytes()]
    return b"".join(parts)
