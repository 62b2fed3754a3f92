"""Checks of the poses from structure from motion, and the reasons why others are missing.

Structure from motion keeps the matches that fit and drops the others. Those dropped tell where it
went wrong: of a photograph placed right, nearly all matches fit its place, however few there are.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from univoxel.capture.model import NO_POINT, WATERMARK, Model, Pair, Placed
from univoxel.data.lens import Lens

STEPS = 10  # of turning a bent lens back: far below a thousandth of a pixel
NEEDED = 15  # matches of a pair that COLMAP begins to believe
WEAK_SHARE = 0.2  # of the median number of points, below which a pose is not trusted
# below which it is not trusted in any case; and matches below which nothing is said of it
WEAK_POINTS = 50
# It is trusted in spite of that with so many trusted partners at least, and so large a share of
# matches that fit: on a head placed right it was .95 and more, on the same head before a still
# background .05 to .4
WEAK_PARTNERS, FITTING_SHARE = 3, 0.9
FITTING_PIXELS = 3.0  # up to which a match fits
WEAK_DOUBT = 0.3  # degrees of its direction that its points may leave open
CONTRADICTED_SHARE = 0.5  # of matches that fit, below which no pose is trusted
TO_SPREAD = np.sqrt(2 / np.pi)  # mean length of an error in a plane to its spread along one axis


@dataclass(frozen=True)
class Partner:
    """A picture that shares verified matches with another."""

    number: int
    matches: int
    fitting: int  # of them to where both were placed


def partners(
    model: Model, pairs: Iterable[Pair], features: Mapping[int, np.ndarray]
) -> dict[int, list[Partner]]:
    """Those of each placed picture among the placed.

    Args:
        pairs: verified ones, see `model.matches`.
        features: where they are in each picture [F, 2], pixels.
    """
    placed = {image.number: image for image in model.images}
    index = {number: i for i, number in enumerate(model.points.number.tolist())}
    looks = {}
    for n, image in placed.items():
        lens = model.cameras[image.camera]
        point = np.array([index.get(p, -1) for p in image.point.tolist()])
        looks[n] = _Look(image, lens, features[n], _rays(features[n], lens), point)
    found: dict[int, list[Partner]] = {number: [] for number in placed}
    for pair in pairs:
        if pair.first not in placed or pair.second not in placed or not len(pair.matches):
            continue
        a, b = looks[pair.first], looks[pair.second]
        for one, other, columns in ((a, b, [0, 1]), (b, a, [1, 0])):
            matches = pair.matches[:, columns]
            # A shift only is what stands still in the pictures, whatever the cameras do
            off = _off(model, one, other, matches)
            fitting = 0 if pair.kind == WATERMARK else int((off < FITTING_PIXELS).sum())
            found[one.image.number].append(Partner(other.image.number, len(matches), fitting))
    return found


@dataclass(frozen=True)
class _Look:
    """A placed picture with its features."""

    image: Placed
    lens: Lens
    xy: np.ndarray  # [F, 2]
    rays: np.ndarray  # [F, 3] directions (x, y, 1)
    point: np.ndarray  # [F] row of the point that each shows, or -1


def _rays(xy: np.ndarray, lens: Lens) -> np.ndarray:
    """Directions (x, y, 1) [F, 3] of features, of a lens that bends by its first coefficient."""
    bent = (xy - np.array(lens.centre)) / np.array(lens.focal)
    straight = bent
    for _ in range(STEPS):
        straight = bent / (1 + lens.radial[0] * (straight**2).sum(1, keepdims=True))
    return np.concatenate([straight, np.ones((len(xy), 1))], 1)


def _off(model: Model, one: _Look, other: _Look, matches: np.ndarray) -> np.ndarray:
    """How far matches [M, 2] of two pictures are from fitting in the first of them, pixels [M].

    Where the other shows a known point, it is how far from it the match is; else from the line
    that the other sees along: Sampson's error. Along such lines a camera may be off unseen.
    """
    mine, theirs = matches.T
    pose, seen = one.image.to_camera, other.image.to_camera
    turn = pose[:, :3] @ seen[:, :3].T
    u, v, w = pose[:, 3] - turn @ seen[:, 3]
    essential = np.array([[0, -w, v], [w, 0, -u], [-v, u, 0]]) @ turn
    x, y = other.rays[theirs], one.rays[mine]
    ahead, back = x @ essential.T, y @ essential
    length = (ahead[:, :2] ** 2).sum(1) + (back[:, :2] ** 2).sum(1)
    off = np.abs((y * ahead).sum(1)) / np.sqrt(np.maximum(length, 1e-30)) * one.lens.focal[0]
    known = other.point[theirs] >= 0
    place = model.points.position[other.point[theirs[known]]] @ pose[:, :3].T + pose[:, 3]
    depth = np.maximum(place[:, 2], 1e-9)
    where = np.stack(one.lens.seen(place[:, 0] / depth, place[:, 1] / depth), 1)
    away = np.linalg.norm(where - one.xy[mine[known]], axis=1)
    off[known] = np.where(place[:, 2] > 0, away, np.inf)
    return off


def doubt(model: Model, image: Placed, error: float) -> float:
    """Spread of where a camera stands, over its distance from what it sees, as degrees.

    It is what points in the picture leave open if they are right themselves: infinite for too few,
    large where they are close to one another.

    Args:
        error: mean reprojection error of its points, pixels.
    """
    index = {number: i for i, number in enumerate(model.points.number.tolist())}
    seen = [index[p] for p in image.point.tolist() if p != NO_POINT and p in index]
    if len(seen) < 6:
        return float("inf")
    turn, shift = image.to_camera[:, :3], image.to_camera[:, 3]
    points = model.points.position[seen] @ turn.T + shift
    x, y, z = points.T
    along = np.stack([1 / z, 0 * z, -x / z**2], 1), np.stack([0 * z, 1 / z, -y / z**2], 1)
    rows = [np.concatenate([np.cross(points, one), one], 1) for one in along]
    slopes = np.concatenate(rows) * model.cameras[image.camera].focal[0]
    try:
        spread = np.linalg.inv(slopes.T @ slopes) * (TO_SPREAD * error) ** 2
    except np.linalg.LinAlgError:
        return float("inf")
    # Turns are about the camera's centre, which shifts alone move
    centre = np.trace(spread[3:, 3:])
    return float(np.degrees(np.sqrt(max(centre, 0)) / np.median(points[:, 2])))


def still(pairs: Sequence[tuple[int, int, int, int]]) -> tuple[int, int]:
    """Pairs whose match is a shift only, and pairs that match at all, of `model.verified_pairs`."""
    matching = [kind for *_, inliers, kind in pairs if inliers > 0]
    return sum(kind == WATERMARK for kind in matching), len(matching)


def weak(
    points: Mapping[int, int],
    partners: Mapping[int, Sequence[Partner]],
    doubts: Mapping[int, float],
) -> dict[int, str]:
    """Pictures whose poses are not to be trusted, and why.

    Of those that hang on few points some are off by degrees, others stand right: they are trusted
    if their matches with trusted ones, of which one after the other joins them, fit their places.

    Args:
        points: of the model that each picture sees.
        partners: as `partners` has them.
        doubts: degrees, as `doubt` has them.
    """
    if not points:
        return {}
    least = max(WEAK_POINTS, WEAK_SHARE * float(np.median(list(points.values()))))
    few = {n: f"only {count} matched points" for n, count in points.items() if count < least}
    against = {}
    for number, those in partners.items():
        share, matches = _fitting(those)
        if matches >= WEAK_POINTS and share < CONTRADICTED_SHARE:
            against[number] = f"{1 - share:.0%} of its matches contradict its pose"
    open_ones = {n for n in few if doubts[n] <= WEAK_DOUBT} - against.keys()
    while True:
        doubtful = few.keys() | against.keys()
        for number in sorted(open_ones, key=lambda n: -points[n]):
            trusted = [p for p in partners[number] if p.number not in doubtful]
            share, matches = _fitting(trusted)
            enough = len(trusted) >= WEAK_PARTNERS and matches >= WEAK_POINTS
            if enough and share >= FITTING_SHARE:
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
        pairs: as `model.verified_pairs` has them.
        elsewhere: of pictures that other models hold, the size of theirs.
    """
    if number is None or not features.get(number):
        return "no features that can be matched"
    if number in elsewhere:
        return f"connected to {elsewhere[number]} photographs, but not to the rest"
    best = max((n for a, b, n, _ in pairs if number in (a, b)), default=0)
    if best < NEEDED:
        return f"at most {best} matches with any other photograph, but {NEEDED} are needed"
    return f"{best} matches with another photograph, but these contradict the other matches"
