"""The circle that cameras stand on, where they do: an object turned before a camera."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from univoxel.camera import Cameras

FEWEST = 8  # cameras, of which three say where a circle is and the others whether it is one
TRIPLES = 500  # through which circles are tried
# Median distance from the circle over its radius, at most. Of a head on a turntable 0.2 %, by two
# programs of structure from motion; by hand it is several per cent
ON = 0.005
# Of that median, beyond which a camera does not stand with the others: normal errors pass it once
# in five thousand times
STRAY = 3.5
LEAST = 0.007  # of the radius: below it nobody minds, 0.4 degrees
MOST = 0.1  # of the radius: what stands further away was put there
MAJORITY = 0.75  # share of the cameras, on the circle at least
AROUND = 0.3  # narrower over wider spread in the circle's plane, at least: a short arc has any axis


@dataclass(frozen=True)
class Circle:
    """A circle, and how far V cameras stand off it."""

    centre: Tensor  # [3] world
    axis: Tensor  # [3] unit, across its plane
    radius: float  # world units, > 0
    off: Tensor  # [V] distances from it over its radius

    def strays(self) -> Tensor:
        """Which of the cameras [V] do not stand with the others, but as if they were meant to."""
        least = max(STRAY * float(self.off.median()), LEAST)
        return (self.off > least) & (self.off < MOST)


def circle_of(cameras: Cameras) -> Circle | None:
    """The circle on which most of the cameras stand, all around; None: they stand on none.

    Circles through three of them are tried, and least squares over those on the best one place it:
    a minority that stands elsewhere has no say.

    Source: Torr and Zisserman 2000, "MLESAC", for the cost of a circle that is tried.
    """
    place = cameras.camera_to_world[:, :, 3].double()
    if len(place) < FEWEST:
        return None
    generator = torch.Generator().manual_seed(0)
    tried = (
        _through(place[torch.randperm(len(place), generator=generator)[:3]], place)
        for _ in range(TRIPLES)
    )
    best = min(filter(None, tried), key=_cost, default=None)
    for within in (2 * ON, LEAST, LEAST):  # again, closer
        if best is None or best.off.median() > 2 * ON:
            return None
        best = _through(place[best.off < max(STRAY * float(best.off.median()), within)], place)
    if best is None or best.off.median() > ON:
        return None
    on = ~best.strays() & (best.off < MOST)
    spread = torch.linalg.svdvals(place[on] - place[on].mean(0))
    if on.double().mean() < MAJORITY or spread[1] < AROUND * spread[0]:
        return None
    return best


def _cost(circle: Circle) -> float:
    """Of how far cameras are off it; those that are far off cost all the same."""
    return float(circle.off.square().clamp_max((2 * ON) ** 2).sum())


def _through(chosen: Tensor, place: Tensor) -> Circle | None:
    """The circle nearest to some places [K, 3], and how far places [V, 3] are off it."""
    middle = chosen.mean(0)
    directions = torch.linalg.svd(chosen - middle, full_matrices=True)[2]
    flat = (chosen - middle) @ directions[:2].T
    system = torch.cat([2 * flat, torch.ones_like(flat[:, :1])], 1)
    found = torch.linalg.lstsq(system, flat.square().sum(1, keepdim=True), driver="gelsd")
    x, y, rest = found.solution[:, 0]
    radius = float((rest + x.square() + y.square()).clamp_min(0).sqrt())
    if not 0 < radius < float("inf"):
        return None
    axis, centre = normalize(directions[2], dim=0), middle + x * directions[0] + y * directions[1]
    away = place - centre
    height = away @ axis
    across = (away - height[:, None] * axis).norm(dim=1)
    return Circle(centre, axis, radius, torch.hypot(height, across - radius) / radius)
