"""Photographs of a turntable whose cameras do not stand on the circle of the others.

Structure from motion that finds too few matches somewhere goes on from there a few degrees off.
Silhouettes and matches of pairs hardly show it: along the circle a round object looks alike, and
what is matched moves along the lines that it is held against.
"""

from __future__ import annotations

import logging
import math

from torch import Tensor

from univoxel.data import Photos
from univoxel.names import CamerasFrom
from univoxel.orbit import circle_of
from univoxel.preparation.config import LIGHT_FRAME, LightFrameConfig
from univoxel.preparation.surroundings import surroundings_stand_still

NAMED = 8  # photographs that the message names, at most

log: logging.Logger = logging.getLogger("univoxel")


def find_strays(
    photos: Photos, wanted: CamerasFrom, cfg: LightFrameConfig = LIGHT_FRAME
) -> Tensor | None:
    """Which photographs [V] were placed off the circle of the others; None: none, or nobody knows.

    Only before surroundings that stood still is the circle known to be one: a turntable has it,
    whoever walks around an object may well step aside.

    Args:
        wanted: as of the configuration; cameras that are given are not doubted.
    """
    circle = None if wanted != "auto" else circle_of(photos.cameras)
    if circle is None or not circle.strays().any() or not surroundings_stand_still(photos, cfg):
        return None
    strays = circle.strays()
    found = strays.nonzero()[:, 0].tolist()
    names = ", ".join(photos.names[view] for view in found[:NAMED])
    log.warning(
        "%d of %d photographs were placed off the circle of their turntable, by up to %.1f "
        "degrees, the others by %.1f in the median: left out are %s%s; `univoxel poses` with their "
        "masks places all anew; see cameras",
        len(found),
        len(photos),
        math.degrees(float(circle.off[strays].max())),
        math.degrees(float(circle.off[~strays].median())),
        names,
        ", ..." if len(found) > NAMED else "",
        extra={"arguments": ("cameras",)},
    )
    return strays
