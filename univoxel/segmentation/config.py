"""Thresholds and lengths of telling an object from its surroundings."""

from __future__ import annotations

from dataclasses import dataclass

from univoxel.validation import check_fields


@dataclass(frozen=True)
class VoteConfig:
    """How masks vote for a hull, and which of them it mends.

    Raises:
        ConfigError: a field is out of range.
    """

    pixels: int = 192  # of the longer side of the pictures that are compared, >= 16
    voxels: int = 96  # along a side of the grid, >= 8; finer ones cost more and mend no better
    first_voxels: int = 40  # of the grid that only looks where the object is, >= 8

    def __post_init__(self) -> None:
        check_fields(self, "at least 16", lambda x: x >= 16, "pixels")
        check_fields(self, "at least 8", lambda x: x >= 8, "voxels", "first_voxels")
