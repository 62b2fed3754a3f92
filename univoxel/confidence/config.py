"""Counts and thresholds of what is said about a scene's confidence."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

from univoxel.errors import DataError
from univoxel.validation import check_fields

_WHOLE = ("at least 1", lambda x: x >= 1)
_ABOVE = ("above 0", lambda x: 0 < x < math.inf)
_SHARE = ("in [0, 1]", lambda x: 0 <= x <= 1)


@dataclass(frozen=True)
class ConfidenceConfig:
    """What the photographs leave open, see confidence/survey.py. It changes no training."""

    # points of the surface, >= 1, that evaluation surveys, for its maps of doubt
    points: int = 20_000
    # points of the surface, >= 1, that are surveyed after training, for the report in words alone
    report_points: int = 2_000
    # observations of a point, >= 1, that are rendered again, at most
    observations: int = 8
    # directions, >= 1, that visibility is measured in where the scene has no map with its own
    directions: int = 64
    # roughness, in (0, 0.5], over which the slope of the render is taken
    roughness_step: float = 0.05
    # views straight from above, > 0, that determine an albedo to a doubt of one half
    enough_views: float = 3.0
    # sRGB, > 0; disagreement with the photographs that means a doubt of one half
    noise: float = 0.02
    # sRGB, in [0, 1]; darker pixels are noise
    black: float = 0.02
    # voxels, > 0, over 2, that opposite sides of a thin part count as farther apart: a pixel takes
    # its doubt from its own side
    normal_scale: float = 3.0
    # nearest points, >= 1, that a pixel takes its doubt from
    neighbours: int = 4
    # views, >= 1; a material that fewer see is reported as a guess
    few_views: int = 3
    # degrees of spread, in [0, 90]; views within are reported as one direction
    one_side: float = 15.0
    # share of a point's light, in [0, 1]; where less comes from outside, that is reported
    min_visibility: float = 0.5
    # mean absolute difference of render and photographs, sRGB, in [0, 1]; where it is more, that is
    # reported: surface, material or light is wrong
    max_disagreement: float = 0.05
    # share of the surface, in [0, 1], below which nothing is reported about it
    min_share: float = 0.01

    def __post_init__(self) -> None:
        counts = ("points", "report_points", "observations", "directions", "neighbours")
        check_fields(self, *_WHOLE, *counts, "few_views")
        check_fields(self, "in (0, 0.5]", lambda x: 0 < x <= 0.5, "roughness_step")
        check_fields(self, *_ABOVE, "enough_views", "noise", "normal_scale")
        check_fields(self, *_SHARE, "black", "min_visibility", "max_disagreement", "min_share")
        check_fields(self, "in [0, 90]", lambda x: 0 <= x <= 90, "one_side")


CONFIDENCE = ConfidenceConfig()


def confidence_of(run: Path) -> ConfidenceConfig:
    """The configuration that a run was trained with; defaults where its config.json has none.

    Raises:
        DataError: config.json cannot be read, or holds something else.
    """
    path = run / "config.json"
    if not path.is_file():
        return CONFIDENCE
    try:
        config = json.loads(path.read_text(encoding="utf-8"))
        return ConfidenceConfig(**config.get("confidence", {}))
    except (TypeError, AttributeError, ValueError) as error:
        raise DataError(f"{path}: expected JSON with fields of confidence: {error}") from None
