"""Photographs of a turntable whose cameras do not stand on the circle of the others.

Structure from motion that finds too few matches somewhere goes on from there a few degrees off.
Silhouettes and matches of pairs hardly show it: along the circle a round object looks alike, and
what is matched moves along the lines that it is held against.
"""

from __future__ import annotations

import logging
import math

from univoxel.data import Photos
from univoxel.orbit import Circle, circle_of
from univoxel.preparation.surroundings import surroundings_stand_still

NAMED = 8  # photographs that the message names, at most

log: logging.Logger = logging.getLogger("univoxel")


def find_strays(photos: Photos) -> Circle | None:
    """The circle of a turntable with photographs that were placed off it; None: none were.

    Only before surroundings that stood still is it known to be a circle: who walks around an object
    may well step aside.
    """
    circle = circle_of(photos.cameras)
    if circle is None or not circle.strays().any() or not surroundings_stand_still(photos):
        return None
    return circle


def say_strays(photos: Photos) -> None:
    """Warn of photographs that were placed off the circle of their turntable, and name them.

    They are trained on all the same: of what they alone show, wrong views are better than none.
    """
    circle = find_strays(photos)
    if circle is None:
        return
    strays = circle.strays()
    found = strays.nonzero()[:, 0].tolist()
    names = ", ".join(photos.names[view] for view in found[:NAMED])
    log.warning(
        "%d of %d photographs were placed off the circle of their turntable, by up to %.1f "
        "degrees, the others by %.1f in the median: what %s%s show will not fit the rest; "
        "`univoxel poses` with their masks places all anew; see cameras",
        len(found),
        len(photos),
        math.degrees(float(circle.off[strays].max())),
        math.degrees(float(circle.off[~strays].median())),
        names,
        ", .." if len(found) > NAMED else "",
        extra={"arguments": ("cameras",)},
    )
