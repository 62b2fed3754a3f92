"""What structure from motion does not say by itself: whether its answer can be right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from univoxel.capture.config import CaptureConfig
from univoxel.capture.database import WATERMARK
from univoxel.capture.evidence import Partner

NEEDED = 15  # matches of a pair that COLMAP begins to believe


def still(pairs: Sequence[tuple[int, int, int, int]]) -> tuple[int, int]:
    """Pairs whose match is a shift alone, and pairs that match at all.

    Args:
        pairs: as `database.verified_pairs` has them.
    """
    matching = [kind for *_, inliers, kind in pairs if inliers > 0]
    return sum(kind == WATERMARK for kind in matching), len(matching)


def weak(
    points: Mapping[int, int],
    partners: Mapping[int, Sequence[Partner]],
    doubts: Mapping[int, float],
    config: CaptureConfig,
) -> dict[int, str]:
    """Pictures whose poses are not to be trusted, and why.

    Of those that hang on few points some are off by degrees, others stand right: they are trusted
    if their matches with trusted ones, of which one after the other joins them, fit their places.

    Args:
        points: of the model that each picture sees.
        partners: as `evidence.partners` has them.
        doubts: degrees, as `evidence.doubt` has them.
    """
    if not points:
        return {}
    least = max(config.weak_points, config.weak_share * float(np.median(list(points.values()))))
    few = {n: f"hangs on {count} points" for n, count in points.items() if count < least}
    against = {}
    for number, those in partners.items():
        share, matches = _fitting(those)
        if matches >= config.weak_points and share < config.contradicted_share:
            against[number] = f"{1 - share:.0%} of its matches contradict its place"
    open_ones = {n for n in few if doubts[n] <= config.weak_doubt} - against.keys()
    while True:
        doubtful = few.keys() | against.keys()
        for number in sorted(open_ones, key=lambda n: -points[n]):
            trusted = [p for p in partners[number] if p.number not in doubtful]
            share, matches = _fitting(trusted)
            enough = len(trusted) >= config.weak_partners and matches >= config.weak_points
            if enough and share >= config.fitting_share:
                break
        else:
            return {**few, **against}
        open_ones.remove(number)
        del few[number]


def _fitting(partners: Sequence[Partner]) -> tuple[float, int]:
    """Share of the matches with partners that fit, and how many there are."""
    matches = sum(p.matches for p in partners)
    return sum(p.fitting for p in partners) / max(matches, 1), matches


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
