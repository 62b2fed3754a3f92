"""Models of COLMAP with their points, read and written whole.

`univoxel.data.colmap` reads cameras and poses alone, of any model; here are tracks as well.
Source: COLMAP's documentation, "Output Format", binary.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from univoxel.data.colmap import read_cameras
from univoxel.data.lens import Lens
from univoxel.files import replacing

SIMPLE_RADIAL = 2  # its number in the files
NO_POINT = -1
SEEN = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
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
        with replacing(folder / name) as temporary:
            temporary.write_bytes(data)


def without(model: Model, numbers: set[int]) -> Model:
    """The model without some images, and without points that fewer than two others show."""
    images = [i for i in model.images if i.number not in numbers]
    p = model.points
    kept = np.array([~np.isin(t["image"], list(numbers)) for t in p.tracks], object)
    tracks = [t[k] for t, k in zip(p.tracks, kept, strict=True)]
    some = np.array([len(np.unique(t["image"])) >= 2 for t in tracks], bool)
    points = Points(
        p.number[some],
        p.position[some],
        p.color[some],
        p.error[some],
        [t for t, s in zip(tracks, some, strict=True) if s],
    )
    images = [
        Placed(
            *(i.number, i.camera, i.name, i.to_camera, i.xy),
            np.where(np.isin(i.point, points.number), i.point, NO_POINT),
        )
        for i in images
    ]
    return Model(model.cameras, images, points)


def _read_images(data: bytes) -> list[Placed]:
    (count,), at = struct.unpack_from("<Q", data), 8
    found = []
    for _ in range(count):
        number, *pose, camera = struct.unpack_from("<i7di", data, at)
        end = data.index(b"\0", at + 64)
        name = data[at + 64 : end].decode("utf-8")
        (features,) = struct.unpack_from("<Q", data, end + 1)
        seen = np.frombuffer(data, SEEN, features, end + 9)
        at = end + 9 + features * SEEN.itemsize
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
