"""What to photograph next: the directions from which most of what is in doubt would be seen.

A photograph is worth what it adds to how well the surface is seen, see `Survey.seen`, over points
weighted by their doubt. Directions are taken one after another, the best first, each with those
before it taken as photographs. No truth is read.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from univoxel.camera import Cameras
from univoxel.confidence.survey import Survey
from univoxel.ops import VisibilityScene
from univoxel.render.transport import MIN_COSINE
from univoxel.sphere import fibonacci_sphere, gaps, side_of
from univoxel.validation import check_fields

# Directions that are weighed, on the whole sphere
CANDIDATES = 600
# Degrees; photographs nearer to one another show much the same
APART = 25.0
# Degrees to the nearest photograph; directions beyond are a gap
GAP = 30.0
# Degrees below which nobody is sent, unless a photograph was taken from there: things stand on
# something
LOWEST = 0.0


STEEP = 65.0  # degrees above or below the horizon, from where on a view has no side
BEST = 0.9  # quantile of the agreement of render and photographs that counts as the best
COUNTS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine")


@dataclass(frozen=True)
class AdviceConfig:
    """How directions for more photographs are chosen."""

    most: int = 6  # directions that are advised, >= 1
    # worth of a photograph, in [0, 1], from which on it is advised: the share of the surface, times
    # its doubt, that it would show as well as many photographs
    least: float = 0.006
    share: float = 0.5  # of the best one's worth, in [0, 1]; less is not worth the walk

    def __post_init__(self) -> None:
        check_fields(self, "at least 1", lambda x: x >= 1, "most")
        check_fields(self, "in [0, 1]", lambda x: 0 <= x <= 1, "least", "share")


ADVICE = AdviceConfig()


@dataclass(frozen=True)
class Advice:
    """Where photographs were taken around an object, and where more would help.

    V photographs, C directions that were weighed, K that are advised, the best first. Directions
    are unit vectors from the middle of the object.
    """

    taken: Tensor  # [V, 3]
    names: list[str]  # V, of the photographs
    front: float  # azimuth of what is called the front, degrees from +X
    front_name: str  # the photograph that says so
    weighed: Tensor  # [C, 3]
    worth: Tensor  # [C] in [0, 1], before any was taken
    least: float  # worth below which no direction is advised, `AdviceConfig.least`
    gap: Tensor  # [C] bool: no photograph is near
    chosen: Tensor  # [K, 3]
    gains: Tensor  # [K] worth of each, with those before it taken
    hidden: float  # share of the surface that no photograph shows, nor any from these directions

    @property
    def nearest(self) -> list[str]:
        """Of each advised direction, the photograph that was taken nearest to it."""
        return [self.names[i] for i in (self.chosen @ self.taken.T).argmax(1).tolist()]


@torch.no_grad()
def advise(
    surveyed: Survey,
    cameras: Cameras,
    names: Sequence[str],
    surface: VisibilityScene,
    cfg: AdviceConfig = ADVICE,
) -> Advice:
    """Weigh directions for more photographs, as far away as those there are.

    Args:
        surveyed: what the photographs fix.
        cameras, names: of the photographs, V >= 1.
        surface: what stands in the way.
    """
    low, high = surveyed.position.amin(0), surveyed.position.amax(0)
    middle = (low + high) / 2
    away = cameras.camera_to_world[:, :, 3] - middle
    taken, distance = normalize(away, dim=1), float(away.norm(dim=1).median())
    lowest = min(LOWEST, float(elevations(taken).min()))
    weighed = fibonacci_sphere(CANDIDATES)
    weighed = weighed[elevations(weighed) >= min(lowest, 89.0)]
    shown = torch.stack([_shown(surveyed, surface, middle + distance * w) for w in weighed])

    straight, agreeing = surveyed.straight.clone(), _agreeing(surveyed)
    nearest = _degrees(weighed, taken).amin(1)
    gap, first = nearest > GAP, None
    chosen, gains = [], []
    while True:
        gain = (surveyed.seen_with(straight + shown) - surveyed.seen_with(straight)) @ (
            1 - surveyed.seen_with(straight) * agreeing
        )
        gain = gain / len(straight) * (nearest / APART).clamp_max(1)
        first = gain if first is None else first
        best = int(gain.argmax())
        least = max(cfg.least, cfg.share * gains[0]) if gains else cfg.least
        if len(chosen) == cfg.most or gain[best] < least:
            break
        chosen.append(best)
        gains.append(float(gain[best]))
        straight = straight + shown[best]
        nearest = torch.minimum(nearest, _degrees(weighed, weighed[best : best + 1])[:, 0])
    front = _front(taken)
    hidden = (surveyed.views == 0) & (shown.amax(0) == 0)
    return Advice(
        taken=taken,
        names=list(names),
        front=float(azimuths(taken[front : front + 1])[0]),
        front_name=names[front],
        weighed=weighed,
        worth=first,
        least=cfg.least,
        gap=gap,
        chosen=weighed[chosen],
        gains=torch.tensor(gains),
        hidden=float(hidden.float().mean()),
    )


def _shown(surveyed: Survey, surface: VisibilityScene, eye: Tensor) -> Tensor:
    """Squared cosine [P] at which a camera sees points; 0 where it does not, as of `observe`."""
    towards = normalize(eye - surveyed.position, dim=1)
    cosine = (surveyed.normal * towards).sum(1)
    facing = (cosine > MIN_COSINE).nonzero()[:, 0]
    offset = surveyed.voxel_size * (surveyed.normal[facing] + towards[facing])
    start = surveyed.position[facing] + offset
    reach = float((eye - start).norm(dim=1).max()) if len(facing) else 0.0
    found = torch.zeros_like(cosine)
    visible = ~surface.occluded(start, towards[facing], 0.0, reach)
    found[facing] = cosine[facing].square() * visible
    return found


def _agreeing(surveyed: Survey) -> Tensor:
    """`Survey.agreeing` [P] beside the best of the surface, in [0, 1]: what disagrees everywhere,
    as after a short training, is mended by no photograph."""
    return (surveyed.agreeing / surveyed.agreeing.quantile(BEST)).clamp_max(1)


def _degrees(a: Tensor, b: Tensor) -> Tensor:
    """Angles [A, B] between unit vectors [A, 3] and [B, 3]."""
    return (a @ b.T).clamp(-1, 1).acos().rad2deg()


def _front(taken: Tensor) -> int:
    """The first photograph that was taken from a side."""
    flat = (elevations(taken).abs() < STEEP).nonzero()[:, 0]
    return int(flat[0]) if len(flat) else 0


def azimuths(direction: Tensor) -> Tensor:
    """Degrees [N] counter-clockwise from +X, of directions [N, 3]."""
    return torch.atan2(direction[:, 1], direction[:, 0]).rad2deg()


def elevations(direction: Tensor) -> Tensor:
    """Degrees [N] above the horizon, of unit directions [N, 3]."""
    return direction[:, 2].clamp(-1, 1).asin().rad2deg()


def place(advice: Advice, direction: Tensor) -> str:
    """A direction [3] in words: a side, or above or below."""
    up = float(elevations(direction[None])[0])
    if abs(up) >= STEEP:
        return "above" if up > 0 else "below"
    return f"the {side_of(float(azimuths(direction[None])[0]) - advice.front)}"


def in_words(advice: Advice) -> list[str]:
    """What to photograph next, a sentence for each side, the most useful first."""
    sides: dict[str, list[int]] = {}
    for k, direction in enumerate(advice.chosen):
        sides.setdefault(place(advice, direction), []).append(k)
    up = elevations(advice.chosen).tolist() if len(advice.chosen) else []
    told = []
    for side, which in sorted(sides.items(), key=lambda s: -float(advice.gains[s[1]].sum())):
        count = COUNTS[len(which)] if len(which) < len(COUNTS) else str(len(which))
        noun = "photograph" if len(which) == 1 else "photographs"
        height = "" if side in ("above", "below") else f", {_heights([up[k] for k in which])}"
        told.append(f"{count} {noun} from {side}{height}".capitalize())
    return told


def _heights(up: list[float]) -> str:
    """Elevations in degrees as a range of tens."""
    low, high = 10 * math.floor(min(up) / 10), 10 * math.ceil(max(up) / 10)
    high = max(high, low + 10)
    if low >= 0:
        return f"{low} to {high} degrees above the horizon"
    if high <= 0:
        return f"{-high} to {-low} degrees below the horizon"
    return f"from {-low} degrees below to {high} degrees above the horizon"


def missing(advice: Advice, gap: float) -> list[str]:
    """Sides that photographs are missing from, as `univoxel poses` tells of them."""
    return gaps(advice.taken.numpy(), advice.names, gap, advice.front)
