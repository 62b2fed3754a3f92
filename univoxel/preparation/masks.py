"""Whether masks end where the object does: there pictures change more than beside it."""

from __future__ import annotations

import logging
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from univoxel.color import linear_to_srgb
from univoxel.data import Photos
from univoxel.names import MasksFrom
from univoxel.preparation.hull import mask_distances

log = logging.getLogger("univoxel")

VIEWS = 32  # photographs at most that are looked at
REACH = 0.015, 6  # of a picture's larger side, and pixels at least: wider masks stay as they are
BEYOND = 3, 5  # pixels further in, from and to, that the object is looked at for comparison
CLEAR = 1.5  # times as much as at the masks' edges, and as further in, pictures change at outlines
RING = 1.0, 4.0  # pixels outside, from and to, that tell whether colours of the edge are repeated
REPEATED = 0.5  # change away from the edge over change along it, below which they are
ONE_COLOR = 0.9  # share of what surrounds the object, from which on it counts as cut away
FEW = 50  # pixels, below which a distance to the edge is left out


@torch.no_grad()
def too_wide(color: Tensor, coverage: Tensor, distance: Tensor) -> int:
    """Pixels by which masks are too wide, all of them alike; 0 where they fit or nothing tells.

    Across the edge of a mask, colours change most at the object's outline: in the mean over all
    photographs everything else, the object's pattern or what stands behind it, lies anywhere.

    Args:
        color: [V, H, W, 3] of photographs, uint8 sRGB or linear. What surrounds the object may be
            there, or be cut away or covered by colours of the object's edge: then masks have to be
            too wide by 3 pixels to be seen so.
        coverage: [V, H, W] in [0, 1], by masks.
        distance: [V, H, W] from `hull.mask_distances`.
    """
    share, least = REACH
    reach = max(least, round(share * max(distance.shape[1:])))
    step = -(-len(color) // VIEWS)
    change = _change(color[::step], coverage[::step], distance[::step], reach + BEYOND[1])
    if change.isnan().all():
        return 0
    edge = change[int((~change.isnan()).nonzero()[0])]
    peak = int(change[: reach + 1].nan_to_num(0).argmax())
    further = change[peak + BEYOND[0] : peak + BEYOND[1] + 1].mean()
    if not (change[peak] > CLEAR * edge and change[peak] > CLEAR * further):
        return 0
    around = torch.arange(max(peak - 1, 0), peak + 2)
    weight = change[around].nan_to_num(0).square()
    return round(float((weight * around).sum() / weight.sum()))


def _change(color: Tensor, coverage: Tensor, distance: Tensor, deepest: int) -> Tensor:
    """How much colours change towards the masks' edges, in the mean over pixels whose depth inside
    is 0, 1, ... deepest: [deepest + 1] sRGB a pixel; NaN where there are few."""
    total, count = torch.zeros(2, deepest + 1)
    for c, covered, d in zip(color, coverage, distance, strict=True):
        encoded = c.float() / 255 if c.dtype == torch.uint8 else linear_to_srgb(c)
        around = encoded[covered < 0.01]
        same = (around == around.median(0).values).all(1) if len(around) else torch.ones(1)
        cut_away = float(same.float().mean()) > ONE_COLOR or _bled(encoded, d)
        hidden = (covered < 0.99) if cut_away else torch.zeros_like(covered, dtype=torch.bool)
        hidden = max_pool2d(hidden[None].float(), 3, 1, 1)[0] > 0
        depth = (0.5 - d).floor().long()
        y, x = (~hidden & (depth >= 0) & (depth <= deepest)).nonzero(as_tuple=True)
        inward, _ = _slopes(encoded, d, y, x)
        total += torch.bincount(depth[y, x], inward, deepest + 1)
        count += torch.bincount(depth[y, x], minlength=deepest + 1)
    return torch.where(count >= FEW, total / count, torch.nan)


def _bled(encoded: Tensor, distance: Tensor) -> bool:
    """Whether what surrounds the object repeats its edge, outwards, as pictures that are meant for
    blending do: colours [H, W, 3] then change along the edge and hardly away from it."""
    y, x = ((distance > RING[0]) & (distance < RING[1])).nonzero(as_tuple=True)
    away, along = _slopes(encoded, distance, y, x)
    return len(y) >= FEW and float(away.sum()) < REPEATED * float(along.sum())


def _slopes(encoded: Tensor, distance: Tensor, y: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """How much colours [H, W, 3] change at pixels [N] across the masks' edges, and along: [N]."""
    slope = torch.stack(torch.gradient(encoded, dim=(0, 1)))[:, y, x]
    inward = torch.stack(torch.gradient(distance, dim=(0, 1)))[:, y, x]
    inward = inward / inward.norm(dim=0).clamp_min(1e-6)
    beside = torch.stack([-inward[1], inward[0]])
    across, along = ((v[..., None] * slope).sum(0).norm(dim=1) for v in (inward, beside))
    return across, along


def taken_in(distance: Tensor, pixels: int) -> Tensor:
    """Coverage [V, H, W] in [0, 1] by masks that end so many pixels further in."""
    return (0.5 - pixels - distance).clamp(0, 1)


def masks_of(photos: Photos, wanted: MasksFrom) -> tuple[Photos, Tensor]:
    """The photographs with masks that fit, as far as those are too wide, and `mask_distances`.

    Args:
        wanted: as of the configuration.
    """
    coverage = photos.coverage()
    distance = mask_distances(coverage)
    off = too_wide(photos.color, coverage, distance)
    if not off:
        return photos, distance
    much = f"masks are {off} {'pixel' if off == 1 else 'pixels'} too wide"
    if wanted == "given":
        log.info("%s: see masks=auto", much, extra={"arguments": ("masks",)})
        return photos, distance
    log.info("%s: they are taken in", much)
    coverage = taken_in(distance, off)
    stored = coverage if photos.alpha.is_floating_point() else (255 * coverage).round().byte()
    return replace(photos, alpha=stored), mask_distances(coverage)
