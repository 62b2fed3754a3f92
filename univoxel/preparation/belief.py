"""Cameras or masks: which are believed where silhouettes contradict one another."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

from torch import Tensor

from univoxel.camera import Cameras
from univoxel.data import Photos
from univoxel.errors import UserError
from univoxel.names import CamerasFrom, MasksFrom
from univoxel.preparation.hull import estimate_bounds, votes_needed
from univoxel.preparation.matches import Agreement, agreement, find_matches
from univoxel.preparation.registration import MAX_CONTRADICTION, contradiction

# Pixels of the median match, up to which cameras can be right: those of structure from motion are
# off by 0.2 to 0.8, those that are off by more are worth refining
MAX_DISTANCE = 1.0
# How many times further silhouettes contradict one another where masks are to blame: cameras
# that are off make both large, the contradiction up to twice as much as the distance
DOUBT = 4.0


log: logging.Logger = logging.getLogger("univoxel")


@dataclass(frozen=True)
class Belief:
    """What is made of cameras and masks."""

    box: tuple[Tensor, Tensor]  # corners [3], [3] around the object
    refined: bool  # whether the cameras are refined
    votes: int = 1  # views that have to carve a node, >= 1; more than one where masks are doubted
    off: float = 0.0  # pixels, >= 0, that doubted masks contradict one another by; may be infinite


def weighed(
    photos: Photos,
    distance: Tensor,
    wanted: CamerasFrom,
    masks: MasksFrom,
) -> Belief:
    """The box around the object, and which of cameras and masks are believed.

    Where silhouettes contradict one another, points matched between photographs are asked. If they
    lie much nearer to where the cameras put them than the contradiction is large, it is the masks
    that are wrong.

    Args:
        distance: [V, H, W] from `hull.mask_distances`.
        wanted, masks: as of the configuration.

    Raises:
        UserError: the silhouettes share no volume.
    """
    cameras = photos.cameras
    try:
        box, none_shared = estimate_bounds(distance, cameras), None
        off = contradiction(distance, cameras, box)
    except UserError as error:
        box, none_shared, off = None, error, math.inf
    if off <= MAX_CONTRADICTION and box is not None:
        return Belief(
            _widened(box, distance, cameras, off, wanted == "refined"), wanted == "refined"
        )
    seen = agreement(cameras, find_matches(photos, distance))
    believed = right(seen, off)
    refined = wanted == "refined" or (wanted == "auto" and not believed)
    if believed or box is not None:
        _say(seen, off, believed, refined)
    if believed and masks == "auto":
        votes = votes_needed(len(cameras))
        return Belief(estimate_bounds(distance, cameras, votes), refined, votes, off)
    if box is None:
        assert none_shared is not None
        raise none_shared
    return Belief(_widened(box, distance, cameras, off, refined), refined)


def unweighed(photos: Photos, distance: Tensor, wanted: CamerasFrom) -> Belief:
    """`weighed` where there is no time to ask: single masks may be wrong, cameras are right.

    Raises:
        UserError: the silhouettes share no volume.
    """
    votes = votes_needed(len(photos))
    box = estimate_bounds(distance, photos.cameras, votes)
    return Belief(box, wanted == "refined", votes)


def right(seen: Agreement | None, off: float) -> bool:
    """Whether cameras are right and it is the masks that make silhouettes contradict one another by
    so many pixels."""
    if seen is None:
        return False
    return seen.median <= min(MAX_DISTANCE, off / DOUBT)


def _widened(
    box: tuple[Tensor, Tensor],
    distance: Tensor,
    cameras: Cameras,
    off: float,
    refined: bool,
) -> tuple[Tensor, Tensor]:
    """The box, or that of wider silhouettes: what wrong cameras share is too small."""
    if not (refined and off > 0):
        return box
    return estimate_bounds(distance, cameras, wider=off)


def _say(seen: Agreement | None, off: float, believed: bool, refined: bool) -> None:
    contradicting = f"silhouettes contradict one another by {off:.1f} pixels"
    if math.isinf(off):
        contradicting = "silhouettes share no volume"
    if seen is not None:
        lie = f"matched points lie {seen.median:.2f} pixels from where the cameras put them"
        contradicting = f"{lie}{': cameras are believed' if believed else ''}; {contradicting}"
    if believed and not refined:
        then = "the masks are rough"
    else:
        then = "cameras are refined" if refined else "see cameras=refined"
    log.info("%s: %s", contradicting, then, extra={"arguments": ("cameras",)})
