"""How many points of a scene are surveyed for what is said about its confidence."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from univoxel.errors import DataError
from univoxel.retired import without_retired
from univoxel.validation import check_fields


@dataclass(frozen=True)
class ConfidenceConfig:
    """What the photographs leave open, see confidence/survey.py. It changes no training."""

    # points of the surface, >= 1, that evaluation surveys, for its maps of doubt
    points: int = 20_000
    # points of the surface, >= 1, that are surveyed after training, for the report in words alone
    report_points: int = 2_000

    def __post_init__(self) -> None:
        check_fields(self, "at least 1", lambda x: x >= 1, "points", "report_points")


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
        values = json.loads(path.read_text(encoding="utf-8")).get("confidence", {})
        return ConfidenceConfig(**without_retired(ConfidenceConfig, values))
    except (TypeError, AttributeError, ValueError) as error:
        raise DataError(f"{path}: expected JSON with fields of confidence: {error}") from None
