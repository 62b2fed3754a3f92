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
    compared_steps: int = 50  # last ones, whose mean PSNR decides on that; >= 1
    lr_backdrop: tuple[float, float] = (0.05, 0.01)  # begin and end, of logits; > 0
    # Weight of the mean opacity at begin and end, > 0: what object and backdrop explain alike goes
    # to the backdrop, and the ball is carved before it grows. More at the begin loses what looks
    # like the room
    emptiness: tuple[float, float] = (0.02, 0.0005)
    redistance_every: int = 50  # steps between turning the sdf back into distances, >= 1
    near: float = 1.5  # voxels from the surface within which the sdf is left as it is, >= 0
    smallest_part: float = 0.02  # of the largest part's volume, in [0, 1]; smaller ones are dropped
    margin: float = 0.05  # of the found box's diagonal, left free around it, >= 0

    def __post_init__(self) -> None:
        check_fields(
            self,
            "one or more shares in (0, 1]",
            lambda x: len(x) > 0 and all(0 < r <= 1 for r in x),
            "radii",
        )
        check_fields(self, "at least 1", lambda x: x >= 1, "compared_steps", "redistance_every")
        check_fields(
            self,
            "two numbers above 0",
            lambda x: len(x) == 2 and min(x) > 0,
            *("lr_backdrop", "emptiness"),
        )
        check_fields(self, "at least 0", lambda x: x >= 0, "near", "margin")
        check_fields(self, "in [0, 1]", lambda x: 0 <= x <= 1, "smallest_part")
