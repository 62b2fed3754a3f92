"""Thresholds and lengths of telling an object from its surroundings."""

from __future__ import annotations

from dataclasses import dataclass

from univoxel.training.config import StageConfig
from univoxel.validation import check_fields

COARSE = StageConfig(0.25, 1500, 0.5, 1536, sharpness=(2.0, 0.7), lr_sdf=(1.0, 0.1), plate=0.02)
FINE = StageConfig(1.0, 300, 0.5, 2048, sharpness=(0.7, 0.35), lr_sdf=(0.1, 0.01))


@dataclass(frozen=True)
class SegmentationConfig:
    """How the object is found in its box.

    Raises:
        ConfigError: a field is out of range.
    """

    coarse: StageConfig = COARSE  # from a ball, once for each radius
    fine: StageConfig = FINE  # of the better one, around what was found
    # Radii of the balls that the object may be at first, shares of the box's half, in (0, 1]. A
    # small one has to grow, and may end before the object does; a large one is carved, and may
    # keep what is not object. The one from which the photographs are rendered better is kept
    radii: tuple[float, ...] = (0.5, 0.65)

    def __post_init__(self) -> None:
        check_fields(
            self,
            "one or more shares in (0, 1]",
            lambda x: len(x) > 0 and all(0 < r <= 1 for r in x),
            "radii",
        )


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
