"""COLMAP's database of features and matches, read in this process: it is SQLite.

Source: COLMAP's documentation, "Database Format".
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

MOST_IMAGES = 2147483647  # what pair ids are made with
WATERMARK = 7  # configuration of a pair whose match is a shift alone, near the pictures' border


@dataclass(frozen=True)
class Pair:
    """Two pictures with matches that were verified."""

    first: int  # image ids
    second: int
    matches: np.ndarray  # [M, 2] which feature of the first and of the second
    kind: int  # configuration


@contextmanager
def _opened(path: Path) -> Iterator[sqlite3.Connection]:
    with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as connection:
        yield connection


def count(path: Path, table: str) -> int:
    """Rows of a table, 0 as long as it is not there."""
    if not path.is_file():
        return 0
    try:
        with _opened(path) as db:
            return int(db.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
    except sqlite3.OperationalError:  # not made yet, or locked
        return 0


def images(path: Path) -> dict[str, tuple[int, int]]:
    """Id and camera of each picture, by name."""
    if not path.is_file():
        return {}
    with _opened(path) as db:
        try:
            rows = db.execute("SELECT name, image_id, camera_id FROM images").fetchall()
        except sqlite3.OperationalError:
            return {}
    return {name: (number, camera) for name, number, camera in rows}


def feature_counts(path: Path) -> dict[int, int]:
    """Number of features by image id."""
    with _opened(path) as db:
        return dict(db.execute("SELECT image_id, rows FROM keypoints").fetchall())


def largest_features(path: Path, image: int, most: int) -> np.ndarray:
    """Unit descriptors [N, D] float32 of the features of largest scale."""
    query = "SELECT rows, cols, data FROM {} WHERE image_id = ?"
    with _opened(path) as db:
        points = db.execute(query.format("keypoints"), (image,)).fetchone()
        described = db.execute(query.format("descriptors"), (image,)).fetchone()
    if not points or not described or not points[0]:
        return np.zeros((0, 128), np.float32)
    points = np.frombuffer(points[2], np.float32).reshape(points[:2])
    # x, y, scale, angle; or x, y and a 2x2 matrix
    scale = points[:, 2] if points.shape[1] < 6 else np.hypot(points[:, 2], points[:, 4])
    descriptors = np.frombuffer(described[2], np.uint8).reshape(described[0], -1)
    chosen = np.argsort(-scale, kind="stable")[:most]
    found = descriptors[chosen].astype(np.float32)
    return found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-9)


def verified_pairs(path: Path) -> list[tuple[int, int, int, int]]:
    """Image ids, inliers and configuration of each pair that was verified."""
    with _opened(path) as db:
        rows = db.execute("SELECT pair_id, rows, config FROM two_view_geometries").fetchall()
    return [(pair // MOST_IMAGES, pair % MOST_IMAGES, n, kind) for pair, n, kind in rows]


def matches(path: Path) -> Iterator[Pair]:
    """Pairs that were verified, with their inliers."""
    with _opened(path) as db:
        for pair, rows, data, kind in db.execute(
            "SELECT pair_id, rows, data, config FROM two_view_geometries WHERE rows > 0"
        ):
            found = np.frombuffer(data, np.uint32).reshape(rows, 2)
            yield Pair(pair // MOST_IMAGES, pair % MOST_IMAGES, found, kind)


def positions(path: Path) -> dict[int, np.ndarray]:
    """Where features are [F, 2], pixels, by image id."""
    with _opened(path) as db:
        rows = db.execute("SELECT image_id, rows, cols, data FROM keypoints").fetchall()
    return {
        number: np.frombuffer(data or b"", np.float32).reshape(count, width)[:, :2].astype(float)
        for number, count, width, data in rows
    }
