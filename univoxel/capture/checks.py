"""What structure from motion does not say by itself: whether its answer can be right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from univoxel.capture.config import CaptureConfig
from univoxel.capture.database import WATERMARK

NEEDED = 15  # matches of a pair that COLMAP begins to believe


def still(pairs: Sequence[tuple[int, int, int, int]]) -> tuple[int, int]:
    """Pairs whose match is a shift alone, and pairs that match at all.

    Args:
        pairs: as `database.verified_pairs` has them.
    """
    matching = [kind for *_, inliers, kind in pairs if inliers > 0]
    return sum(kind == WATERMARK for kind in matching), len(matching)


def weak(points: Mapping[int, int], config: CaptureConfig) -> set[int]:
    """Pictures that hang on few points: their poses are off by degrees where any are.

    Args:
        points: of the model that each picture sees.
    """
    if not points:
        return set()
    least = max(config.weak_points, config.weak_share * float(np.median(list(points.values()))))
    return {number for number, count in points.items() if count < least}


def why_not(
    number: int | None,
    features: Mapping[int, int],
    pairs: Sequence[tuple[int, int, int, int]],
    elsewhere: Mapping[int, int],
) -> str:
    """Why a picture has no place.

    Args:
        number: its id in the database, None if it is not there.
        features: by id.
        pairs: as `database.verified_pairs` has them.
        elsewhere: of pictures that other models hold, the size of theirs.
    """
    if number is None or not features.get(number):
        return "nothing in it to hold on to"
    if number in elsewhere:
        return f"with {elsewhere[number]} others that nothing connects to the rest"
    best = max((n for a, b, n, _ in pairs if number in (a, b)), default=0)
    if best < NEEDED:
        return f"{best} matches with its best partner; {NEEDED} needed"
    return f"{best} matches with its best partner, which do not fit the others"
