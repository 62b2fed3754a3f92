"""Whether the light stood still around the object, or turned about it with the camera.

Before a camera that stands still an object is turned, and with it, in the object's world, the light
turns as the camera does. Then a point is bright where its normal faces the light as seen from the
camera. Under a light that stands still a point keeps its shade, and changes only by what it
mirrors. Each is a smooth function on the sphere, of the normal in the camera's frame or of the
mirrored direction in the world: the one that explains more of how points change from photograph to
photograph is believed.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import torch
from torch import Tensor

from univoxel.color import CLIPPED, linear_to_srgb
from univoxel.data import Photos
from univoxel.errors import DataError
from univoxel.grid import GridShape
from univoxel.lights.turntable import Turntable
from univoxel.names import LightFrameOrAuto
from univoxel.preparation.observed_hull import observe_hull
from univoxel.preparation.surroundings import surroundings_stand_still
from univoxel.render.transport import Observations
from univoxel.sphere import real_harmonics

# Points of the surface whose colours are compared
POINTS = 1500
# sRGB; darker colours are left out: rounding to 8 bits is too large a part of them
DARK = 0.05
# Natural log; the scale of the Cauchy cost of a colour that is not explained
CAUCHY = 0.1
# Rounds of iteratively reweighted least squares
ROUNDS = 6
# How many times as much a light that turns has to explain as one that stands still. Of four
# rendered scenes under a still light it was 0.1 to 0.2 times, of a bronze head on a turntable 1.8
# times
BETTER = 1.0
# Share of the cost that it has to explain at least, over `better`
LEAST = 0.03
# `better` where the surroundings do not say whether they stood still. Of objects on rings of
# cameras it was up to 3 under a still light, and 60 under one that turned; of a shiny ball, 3.2
BETTER_ALONE = 3.0
# `least` there: times `better_alone` it is above the 14 % of the cost that a light taken to turn
# explained under a still one, and below the 30 and 70 % under one that turned
LEAST_ALONE = 0.07


log: logging.Logger = logging.getLogger("univoxel")


@dataclass(frozen=True)
class Explained:
    """Shares, in [0, 1], of the robust cost of how points change that go away."""

    by_still_light: float
    by_turning_light: float


def turntable_of(
    photos: Photos,
    hull: Tensor,
    grid: GridShape,
    frame: LightFrameOrAuto,
) -> Turntable | None:
    """The turntable that the photographs were taken on; None: the light stood still.

    Args:
        photos: their cameras where they are believed to be.
        hull: [X, Y, Z] sdf of the visual hull on the grid, world units.
        frame: what is known.

    Raises:
        DataError: a turntable is asked for, and the cameras do not say where its axis is.
    """
    if frame == "world":
        return None
    turntable = Turntable.of(photos.cameras)
    if frame == "turntable":
        if turntable is None:
            raise DataError(
                f"{photos.folder}: light_frame turntable: the cameras do not stand around one "
                "upright axis, so where the turntable's is cannot be told",
                "light_frame",
            )
        return turntable
    observations = None if turntable is None else observe_hull(photos, hull, grid, POINTS)
    if turntable is None or observations is None:
        return None
    found = explained(observations, turntable)
    log.debug("light frame: %s", found)
    still_around = surroundings_stand_still(photos)
    if still_around is False:  # the camera went around the object
        return None
    better, least = BETTER, LEAST
    if still_around is None:
        better, least = BETTER_ALONE, LEAST_ALONE
    if found.by_turning_light < better * max(found.by_still_light, least):
        return None
    log.info(
        "the light turns with the camera, as on a turntable: that explains %.0f %% of how points "
        "change from photograph to photograph, a light that stands still %.0f %%; see light_frame",
        100 * found.by_turning_light,
        100 * found.by_still_light,
        extra={"arguments": ("light_frame",)},
    )
    return turntable


@torch.no_grad()
def explained(observations: Observations, turntable: Turntable) -> Explained:
    """How much of the changes of points from photograph to photograph either light explains."""
    point = torch.repeat_interleave(observations.offsets.diff())
    encoded = linear_to_srgb(observations.color)
    usable = (encoded.mean(1) > DARK) & (encoded < CLIPPED).all(1)
    point, view, wo = point[usable], observations.view[usable], observations.wo[usable]
    log_color = observations.color[usable].mean(1).log()
    normal = observations.normal[point]
    mirrored = 2 * (normal * wo).sum(1, keepdim=True) * normal - wo
    cosine, sine = turntable.turn(observations.eye)
    lit = turntable.into_light(normal, (cosine[view], sine[view]))
    nothing = normal[:, :0]
    none, still, turning = (
        cost(log_color, basis, point) for basis in (nothing, smooth(mirrored), smooth(lit))
    )
    return Explained(1 - still / none, 1 - turning / none)


def smooth(direction: Tensor) -> Tensor:
    """Smooth functions [N, 8] of directions [N, 3], without the constant one."""
    return real_harmonics(2, direction)[:, 1:]


def cost(log_color: Tensor, basis: Tensor, point: Tensor) -> float:
    """Cauchy cost of log colours [N] of points [N], each of which has an albedo of its own, after
    the best sum of the basis [N, K]."""
    log_color, basis = log_color.double(), basis.double()
    count = int(point.max()) + 1 if len(point) else 0
    weight = torch.ones_like(log_color)
    rest = log_color
    for _ in range(ROUNDS):
        total = weight.new_zeros(count).index_add_(0, point, weight).clamp_min(1e-9)

        def centred(values: Tensor, weight: Tensor = weight, total: Tensor = total) -> Tensor:
            sums = values.new_zeros(count, values.shape[1])
            sums.index_add_(0, point, weight[:, None] * values)
            return values - (sums / total[:, None])[point]

        shades = centred(basis)
        rest = centred(log_color[:, None])
        weighted = weight[:, None] * shades
        system = weighted.T @ shades + 1e-6 * torch.eye(shades.shape[1], dtype=torch.double)
        rest = (rest - shades @ torch.linalg.solve(system, weighted.T @ rest))[:, 0]
        weight = 1 / (1 + (rest / CAUCHY).square())
    return max(float(torch.log1p((rest / CAUCHY).square()).sum()), 1e-9)
