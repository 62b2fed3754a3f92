"""Detects masks that extend past the object, where images change most beside the mask's edge."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from univoxel.color import linear_to_srgb
from univoxel.core import log, memmap
from univoxel.core.choices import MasksFrom
from univoxel.core.memmap import parallel_map
from univoxel.data import Photos
from univoxel.data.photos import coverage_of
from univoxel.preparation.hull import mask_distances

# Photographs that are looked at, at most and at least, and pixels of them, about: the excess is a
# mean over them
MOST_VIEWS, VIEWS, PIXELS = 32, 8, 8e6
# Share of a picture's larger side up to which an excess is looked for: wider masks stay as they
# are
REACH_SHARE = 0.015
# Pixels up to which an excess is looked for at least, in small pictures
REACH_PIXELS = 6
# Pixels further in, from and to, whose colour change an outline is compared with
COMPARISON = (3, 5)
# Colour change at an outline over that at the masks' edge, and over that further in: less is the
# object's pattern
CONTRAST = 1.5
# Pixels outside of the masks, from and to, that tell whether they repeat the colour of the edge
RING = (1.0, 4.0)
# Colour change away from the edge over change along it, below which the edge's colours are
# repeated outside, as pictures for blending do: those show no surroundings
REPEATED = 0.5
# Share of the surroundings that have one colour, above which they are cut away
ONE_COLOR = 0.9
# Pixels at a depth below which their mean is noise and is left out
MIN_PIXELS = 50


@torch.no_grad()
def mask_excess(
    color: Sequence[Tensor] | Tensor,
    coverage: Sequence[Tensor] | Tensor,
    distance: Sequence[Tensor] | Tensor,
) -> int:
    """Pixels by which masks are too wide, all of them alike; 0 where they fit or nothing tells.

    Across the edge of a mask, colours change most at the object's outline: in the mean over all
    photographs everything else, the object's pattern or what is behind it, lies anywhere.

    Args:
        color: V photographs [H, W, 3], uint8 sRGB or linear. What surrounds the object may be
            there, or be cut away or covered by colours of the object's edge: then masks have to be
            too wide by 3 pixels to be seen so.
        coverage: V, [H, W] by masks, stored as in `Photos`.
        distance: V, [H, W] from `hull.mask_distances`.
    """
    longest = max(max(d.shape) for d in distance)
    reach = max(REACH_PIXELS, round(REACH_SHARE * longest))
    views = min(MOST_VIEWS, max(VIEWS, int(PIXELS / distance[0].numel())))
    step = -(-len(color) // views)
    near, far = COMPARISON
    change = _change(color[::step], coverage[::step], distance[::step], reach + far)
    if change.isnan().all():
        return 0
    edge = change[int((~change.isnan()).nonzero()[0])]
    peak = int(change[: reach + 1].nan_to_num(0).argmax())
    further = change[peak + near : peak + far + 1].mean()
    if not (change[peak] > CONTRAST * edge and change[peak] > CONTRAST * further):
        return 0
    around = torch.arange(max(peak - 1, 0), peak + 2)
    weight = change[around].nan_to_num(0).square()
    return round(float((weight * around).sum() / weight.sum()))


def _change(
    color: Sequence[Tensor] | Tensor,
    coverage: Sequence[Tensor] | Tensor,
    distance: Sequence[Tensor] | Tensor,
    deepest: int,
) -> Tensor:
    """How much colours change towards the masks' edges, in the mean over pixels whose depth inside
    is 0, 1, ... deepest: [deepest + 1] sRGB a pixel; NaN where there are few."""

    def of_view(view: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        c, stored, d = view
        encoded, covered = as_srgb(c), coverage_of(stored)
        away = cut_away(encoded, covered, d)
        hidden = (covered < 0.99) if away else torch.zeros_like(covered, dtype=torch.bool)
        hidden = max_pool2d(hidden[None].float(), 3, 1, 1)[0] > 0
        depth = (0.5 - d).floor().long()
        y, x = (~hidden & (depth >= 0) & (depth <= deepest)).nonzero(as_tuple=True)
        inward, _ = _slopes(encoded, d, y, x)
        at = depth[y, x]
        return torch.bincount(at, inward, deepest + 1), torch.bincount(at, minlength=deepest + 1)

    total, count = torch.zeros(2, deepest + 1)
    for change, pixels in parallel_map(of_view, zip(color, coverage, distance, strict=True)):
        total += change
        count += pixels
    return torch.where(count >= MIN_PIXELS, total / count, torch.nan)


def as_srgb(stored: Tensor) -> Tensor:
    """Stored colours, uint8 sRGB or linear, as sRGB in [0, 1]."""
    return stored.float() / 255 if stored.dtype == torch.uint8 else linear_to_srgb(stored)


def cut_away(encoded: Tensor, covered: Tensor, distance: Tensor) -> bool:
    """Whether a photograph [H, W, 3] sRGB no longer shows what is around the object."""
    around = encoded[covered < 0.01]
    same = (around == around.median(0).values).all(1) if len(around) else torch.ones(1)
    return float(same.float().mean()) > ONE_COLOR or repeats_edge(encoded, distance)


def repeats_edge(encoded: Tensor, distance: Tensor) -> bool:
    """Whether what surrounds the object repeats its edge, outwards, as pictures that are meant for
    blending do: colours [H, W, 3] then change along the edge and hardly away from it."""
    y, x = ((distance > RING[0]) & (distance < RING[1])).nonzero(as_tuple=True)
    away, along = _slopes(encoded, distance, y, x)
    return len(y) >= MIN_PIXELS and float(away.sum()) < REPEATED * float(along.sum())


def _slopes(encoded: Tensor, distance: Tensor, y: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """How much colours [H, W, 3] change at pixels [N] across the masks' edges, and along: [N]."""
    slope = torch.stack(torch.gradient(encoded, dim=(0, 1)))[:, y, x]
    inward = torch.stack(torch.gradient(distance, dim=(0, 1)))[:, y, x]
    inward = inward / inward.norm(dim=0).clamp_min(1e-6)
    beside = torch.stack([-inward[1], inward[0]])
    across, along = ((v[..., None] * slope).sum(0).norm(dim=1) for v in (inward, beside))
    return across, along


def eroded(distance: Tensor, pixels: int) -> Tensor:
    """Coverage in [0, 1] by masks that end so many pixels further in; 0 beyond a picture."""
    return (0.5 - pixels - distance).clamp(0, 1)


def fitted_masks(photos: Photos, wanted: MasksFrom) -> tuple[Photos, Tensor]:
    """The photographs with masks that fit, as far as those are too wide, and `mask_distances`.

    Args:
        wanted: as in the configuration.
    """
    cameras = photos.cameras
    distance = mask_distances(photos.alpha, cameras)
    colors, covered, away = (
        [cameras.cut(v, picture) for v, picture in enumerate(pictures)]
        for pictures in (photos.color, photos.alpha, distance)
    )
    excess = mask_excess(colors, covered, away)
    if not excess:
        return photos, distance
    much = f"masks extend {excess} {'pixel' if excess == 1 else 'pixels'} past the object's edge"
    if wanted == "given":
        log.info("%s: masks=auto erodes them", much, extra={"arguments": ("masks",)})
        return photos, distance
    log.info("%s: they are eroded", much)
    return with_masks(photos, lambda view: eroded(distance[view], excess))


def with_masks(photos: Photos, coverage: Callable[[int], Tensor]) -> tuple[Photos, Tensor]:
    """The photographs with masks of such coverage [H, W] by view, and `mask_distances`."""
    stored = memmap.zeros(photos.alpha.shape, photos.alpha.dtype)
    exact = memmap.zeros(photos.alpha.shape, torch.float32)
    for view in range(len(photos)):
        exact[view] = coverage(view)
        covered = exact[view]
        stored[view] = covered if stored.is_floating_point() else (255 * covered).round().byte()
    return replace(photos, alpha=stored), mask_distances(exact, photos.cameras)
