"""How photographs' exposures differ, as far as what they show of the same places tells."""

from __future__ import annotations

import logging
import math

import torch
from torch import Tensor

from univoxel.color import CLIPPED, linear_to_srgb
from univoxel.data import Photos
from univoxel.grid import GridShape
from univoxel.names import Varying
from univoxel.preparation.observed_hull import observe_hull

# Points of the surface whose colours are compared
POINTS = 6000
# sRGB; darker colours are left out: rounding to 8 bits and reflections are too large a part of
# them
DARK = 0.1
# Natural log; the scale of the Cauchy weights: what is seen of one point may differ by this
# before it counts for less
CAUCHY = 0.07
# Rounds of iteratively reweighted least squares
ROUNDS = 20
# Points that speak for a gain of 1: of a photograph that shares none with others
PRIOR = 1e-3
# Share of the object's pixels that are clipped, above which it is said
MUCH_CLIPPED = 0.03
# Stops, root mean square, above which exposures differ. Where they are alike, reflections and a
# hull that is too large look like 0.01 to 0.16 stops. Metal or light that changes looks like
# 0.25: gains do no harm there
MIN_STOPS = 0.2


log: logging.Logger = logging.getLogger("univoxel")


@torch.no_grad()
def log_gains(photos: Photos, sdf: Tensor, grid: GridShape) -> Tensor:
    """The log gains of photographs that agree best on how bright a surface's points are.

    log brightness_pv = log gain_v + log albedo_p, in robust least squares: many sightings are of
    something else, where the surface is off, and highlights move.

    Args:
        photos: V, their cameras where they are believed to be.
        sdf: [X, Y, Z] world units, such as of the visual hull.
        grid: of the sdf.

    Returns:
        [V], of mean 0; 0 for all if the photographs show no surface.

    Source: Brown and Lowe 2007, "Automatic panoramic image stitching using invariant features", for
    gains from overlaps; Cauchy's weights, iterated, as in robust statistics.
    """
    gain = torch.zeros(len(photos))
    seen = observe_hull(photos, sdf, grid, POINTS)
    if seen is None:
        return gain
    encoded = linear_to_srgb(seen.color)
    usable = (encoded.mean(1) > DARK) & (encoded < CLIPPED).all(1)
    point_and_view = torch.repeat_interleave(seen.offsets.diff())[usable], seen.view[usable]
    log_color, observed = torch.zeros(2, POINTS, len(photos), dtype=torch.double)
    log_color[point_and_view] = seen.color[usable].mean(1).double().log()
    observed[point_and_view] = 1.0
    weight = observed
    for _ in range(ROUNDS):
        share = weight / weight.sum(1, keepdim=True).clamp_min(1e-9)
        # The albedos eliminated: a Laplacian of the photographs, tied by the points that they share
        system = torch.diag(weight.sum(0) + PRIOR) - weight.T @ share
        right_side = (weight * (log_color - (share * log_color).sum(1, keepdim=True))).sum(0)
        gain = torch.linalg.solve(system, right_side)
        gain = gain - gain.mean()
        albedo = (share * (log_color - gain)).sum(1, keepdim=True)
        weight = observed / (1 + ((log_color - gain - albedo) / CAUCHY).square())
    return gain.float()


def clipped_share(photos: Photos) -> float:
    """Share of the object's pixels of which a channel is clipped: they were at least so bright.

    Linear photographs have none.
    """
    if photos.color.dtype != torch.uint8:
        return 0.0
    clipped = shown = 0
    for view in range(len(photos)):
        color, alpha = photos.stored(view)
        object_ = alpha > 0.5 * (1 if alpha.is_floating_point() else 255)
        shown += int(object_.sum())
        clipped += int((color[object_] > 255 * CLIPPED).any(1).sum())
    return clipped / max(shown, 1)


def say_clipped(photos: Photos) -> None:
    """Say so where much of the object is clipped."""
    share = clipped_share(photos)
    if share > MUCH_CLIPPED:
        log.info(
            "%.0f %% of the object's pixels are overexposed: they count as at least so bright; "
            "shorter exposures would tell more",
            100 * share,
        )


def varying_and_gains(
    photos: Photos,
    hull: Tensor,
    grid: GridShape,
    varying: Varying,
    look: bool,
) -> tuple[Varying, Tensor | None]:
    """What differs from photograph to photograph, and their log gains [V] where anything does.

    Args:
        photos: V, their cameras where they are believed to be.
        hull: [X, Y, Z] sdf of the visual hull, world units.
        grid: of the hull.
        varying: what is known to differ.
        look: whether to find out if exposures do, where nothing is known to differ.
    """
    if varying == "none" and not look:
        return varying, None
    gains = log_gains(photos, hull, grid)
    stops = float(gains.square().mean().sqrt()) / math.log(2)
    if varying == "none":
        if stops < MIN_STOPS:
            return varying, None
        varying = "exposure"
        log.info(
            "exposures differ by %.2f stops from photograph to photograph: a gain is learned for "
            "each, see varying",
            stops,
            extra={"arguments": ("varying",)},
        )
    return varying, gains
