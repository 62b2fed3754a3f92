"""What structure from motion does not say by itself: whether its answer can be right."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from univoxel.capture.config import CaptureConfig
from univoxel.capture.database import WATERMARK

NEEDED = 15  # matches of a pair that COLMAP begins to believe
# Of an azimuth from the first photograph, counter-clockwise seen from above: eighths of a turn
SIDES = (
    *("front", "front right", "right", "back right"),
    *("back", "back left", "left", "front left"),
)
HIGH = 30.0  # degrees: without a photograph from so far above, tops are not seen


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


def gaps(directions: np.ndarray, names: Sequence[str], config: CaptureConfig) -> list[str]:
    """Where photographs are missing around the object, for people.

    Args:
        directions: [V, 3] from the object to each camera, +Z up, the first photograph at -Y.
    """
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    azimuth = (np.degrees(np.arctan2(unit[:, 1], unit[:, 0])) + 90) % 360
    height = np.degrees(np.arcsin(unit[:, 2].clip(-1, 1)))
    told = []
    order = np.argsort(azimuth)
    steps = np.diff(azimuth[order], append=azimuth[order[0]] + 360)
    for k in np.argsort(-steps).tolist():
        if steps[k] < config.gap:
            break
        begin, end = int(order[k]), int(order[(k + 1) % len(order)])
        low = azimuth[begin]
        side = SIDES[math.floor((low + steps[k] / 2) / 45 + 0.5) % 8]
        told.append(
            f"no photograph from the {side}, {steps[k]:.0f} degrees between {names[begin]} and "
            f"{names[end]}"
        )
    if height.max() < HIGH:
        told.append(f"no photograph from above {height.max():.0f} degrees")
    return told
