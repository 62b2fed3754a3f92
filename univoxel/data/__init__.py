"""Photographs, cameras and ground truth from files."""

from pathlib import Path

from univoxel.data.base import DataError, Photos, Truth
from univoxel.data.blender import (
    load_blender,
    load_cameras,
    load_points,
    load_relit,
    load_truth,
    relight_maps,
)

__all__ = [
    "DataError",
    "Photos",
    "Truth",
    "load_cameras",
    "load_photos",
    "load_points",
    "load_relit",
    "load_truth",
    "relight_maps",
]


def load_photos(folder: str | Path, split: str = "train") -> Photos:
    """Read the photographs of one split in whatever layout the folder has.

    Raises:
        DataError: one line that names the file, what was expected and what came.
    """
    return load_blender(folder, split)
