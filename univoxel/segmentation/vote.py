"""Masks of many photographs vote for a hull, and it tells which of them are wrong.

A mask that lost a part of the object, or kept what it stands on, is contradicted by the others.
What most of them have in common is a hull. Its silhouettes are coarse, but right where single masks
are not.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, interpolate, max_pool2d

from univoxel.bars import track
from univoxel.camera import Cameras, looked_at, pixel_rays, project
from univoxel.errors import UserError
from univoxel.grid import GridShape, fit_grid
from univoxel.preparation.gaps import carve_gaps_
from univoxel.preparation.hull import mask_distances
from univoxel.segmentation.config import VoteConfig

# Sides of the first grid, in those of what half of the pictures show whole
ROOM = 1.6
# Share of its largest vote: what may be the object
AROUND = 0.5
# Share of the photographs that have to see a voxel: what few see, few decide on
SEEN_BY = 0.25
# Least and largest vote from which on a voxel may belong to the hull. The best depends on how many
# masks are wrong: it is searched
LOWEST = 0.3
HIGHEST = 0.99
# IoU below the median's, from where on a mask is wrong. As much of it has to be more than a pixel
# off
BELOW = 0.08
# IoU with its silhouette below which a mask is wrong whatever the others have. If more than half
# are, it is the hull that is wrong
LEAST = 0.75
# Voxels beside the silhouette within which a mended mask is kept
BAND = 1.5


VOTE = VoteConfig()
BESIDE, MISSING = "keeps something beside the object", "misses a part"
THRESHOLDS = 70  # that are tried
SAMPLES = 1 << 20  # of the grid, that are looked up at once


@dataclass(frozen=True)
class Hull:
    """What the masks agree on."""

    grid: GridShape
    vote: Tensor  # [X, Y, Z] mean of the masks over the photographs that see a node
    threshold: float  # the vote from which on a node belongs to the object
    usual: float  # median IoU of masks and silhouettes


@dataclass(frozen=True)
class Verdict:
    """What the hull says about the mask of a photograph."""

    agreement: float | None  # IoU with its silhouette; None: there was no vote
    fault: str  # BESIDE, MISSING, or nothing
    mask: Tensor  # [H, W] in [0, 1]: mended where there is a fault, else as it was


def elect(
    masks: Iterable[Tensor], cameras: Cameras, cfg: VoteConfig = VOTE
) -> tuple[Hull, list[Tensor]]:
    """The hull that the masks agree on best, and its `largest_votes` in each picture.

    Args:
        masks: [H, W] in [0, 1] of each camera, of pictures of any size.

    Raises:
        UserError: the masks show nothing in common.
    """
    small = [shrunk(mask, cfg.pixels) for mask in masks]
    lower, upper = surroundings(cameras)
    middle, half = (lower + upper) / 2, ROOM * (upper - lower) / 2
    first = fit_grid(middle - half, middle + half, cfg.first_voxels**3)
    vote = votes(small, cameras, first)
    if not float(vote.max()):
        raise UserError("the masks of the photographs have nothing in common: check masks, cameras")
    second = _around(first, vote >= AROUND * vote.max(), (cfg.voxels // 2) ** 3)
    smaller = [shrunk(mask, cfg.pixels // 2) for mask in small]
    vote = votes(smaller, cameras, second)
    threshold, _, _ = _compared(second, vote, smaller, cameras)
    grid = _around(second, vote >= threshold, cfg.voxels**3)
    vote = votes(small, cameras, grid)
    threshold, usual, largest = _compared(grid, vote, small, cameras)
    if carve_gaps_(vote, threshold, small, cameras, grid):
        threshold, usual, largest = _compared(grid, vote, small, cameras)
    return Hull(grid, vote, threshold, usual), largest


def surroundings(cameras: Cameras) -> tuple[Tensor, Tensor]:
    """A cube around what the cameras look at, as large as half of their pictures show whole."""
    centre = looked_at(cameras)
    away = (cameras.camera_to_world[:, :, 3] - centre).norm(dim=1)
    tangent = cameras.size_of_each().amin(1) / (2 * cameras.focal.max(1).values)
    half = float((away * tangent / (1 + tangent.square()).sqrt()).median())
    return centre - half, centre + half


def _around(grid: GridShape, inside: Tensor, voxels: int) -> GridShape:
    """A grid over the nodes [X, Y, Z] that are inside, and a voxel around them."""
    nodes = grid.nodes()[inside]
    return fit_grid(nodes.amin(0) - grid.voxel_size, nodes.amax(0) + grid.voxel_size, voxels)


def _compared(
    grid: GridShape, vote: Tensor, masks: Sequence[Tensor], cameras: Cameras
) -> tuple[float, float, list[Tensor]]:
    """The threshold whose silhouettes agree best with masks, their median IoU, `largest_votes`."""
    levels = torch.linspace(LOWEST, HIGHEST, THRESHOLDS)
    largest = [
        largest_votes(grid, vote, cameras, view, mask.shape)
        for view, mask in enumerate(track(masks, "comparing masks"))
    ]
    agreed = [overlaps(one, mask, levels) for one, mask in zip(largest, masks, strict=True)]
    medians = torch.stack(agreed).quantile(0.5, 0)
    best = int(medians.argmax())
    return float(levels[best]), float(medians[best]), largest


def judge(
    hull: Hull,
    mask: Tensor,
    cameras: Cameras,
    view: int,
    largest: Tensor | None = None,
    cfg: VoteConfig = VOTE,
) -> Verdict:
    """Whether a mask [H, W] is contradicted by the hull, and the mask mended if so.

    Args:
        largest: `largest_votes` of the picture, where they are known.
    """
    small = shrunk(mask, cfg.pixels)
    if largest is None:
        largest = largest_votes(hull.grid, hull.vote, cameras, view, small.shape)
    agreement = float(overlaps(largest, small, torch.tensor([hull.threshold])))
    silhouette, shown = largest >= hull.threshold, small >= 0.5
    # Edges that are a pixel off are no fault, though they are much of an object that is seen flat
    beside, missing = (shown & ~_grown(silhouette)).sum(), (silhouette & ~_grown(shown)).sum()
    differs = (beside + missing) / (silhouette | shown).sum().clamp_min(1)
    if agreement >= max(hull.usual - BELOW, LEAST) or differs <= BELOW:
        return Verdict(agreement, "", mask)
    fault = BESIDE if beside > missing else MISSING
    return Verdict(agreement, fault, _mended(mask, silhouette, hull, cameras, view, cfg))


def votes(masks: Sequence[Tensor], cameras: Cameras, grid: GridShape) -> Tensor:
    """Mean of the masks [H, W] over the cameras that see a node: [X, Y, Z] in [0, 1].

    It is 0 where fewer than their share see it.
    """
    nodes = grid.nodes().reshape(-1, 3)
    total, seen_by = torch.zeros(len(nodes)), torch.zeros(len(nodes))
    for view, mask in enumerate(track(masks, "masks vote")):
        pixel, depth = project(cameras, view, nodes)
        uv = pixel * (2 / torch.tensor(cameras.size(view))) - 1
        seen = (depth > 0) & (uv.abs() <= 1).all(1)
        found = grid_sample(
            mask[None, None], uv[None, None], align_corners=False, padding_mode="border"
        )
        total += torch.where(seen, found[0, 0, 0], 0.0)
        seen_by += seen
    enough = seen_by >= max(SEEN_BY * len(masks), 1)
    return torch.where(enough, total / seen_by.clamp_min(1), 0.0).reshape(grid.size)


def largest_votes(
    grid: GridShape, vote: Tensor, cameras: Cameras, view: int, shape: tuple[int, ...]
) -> Tensor:
    """The largest vote along the rays of a picture [H, W] of this shape; 0 beside the grid."""
    width, height = cameras.size(view)
    row, column = (torch.arange(n) + 0.5 for n in shape)
    y, x = torch.meshgrid(row * (height / shape[0]), column * (width / shape[1]), indexing="ij")
    rays = pixel_rays(cameras, torch.tensor(view), torch.stack([x, y], -1).reshape(-1, 2))
    lower, upper = grid.bounds()
    # Where a ray is within the slabs of the three axes
    away = torch.where(rays.direction.abs() < 1e-9, 1e-9, rays.direction)
    ends = torch.stack([(lower - rays.origin) / away, (upper - rays.origin) / away])
    enters = ends.amin(0).amax(1).clamp_min(0)
    leaves = ends.amax(0).amin(1)
    meets = (leaves > enters).nonzero()[:, 0]
    result = torch.zeros(len(away))
    if not len(meets):
        return result.reshape(shape)
    steps = max(2, round(float((leaves - enters)[meets].max()) / grid.voxel_size))
    along = (torch.arange(steps) + 0.5) / steps
    volume = vote.permute(2, 1, 0)[None, None]  # grid_sample's x is the last axis
    for some in meets.split(max(1, SAMPLES // steps)):
        begin, length = enters[some, None], (leaves - enters)[some, None]
        t = begin + length * along
        points = rays.origin[some, None] + t[..., None] * rays.direction[some, None]
        where = 2 * (points - lower) / (upper - lower) - 1
        found = grid_sample(volume, where[None, None], align_corners=True)
        result[some] = found[0, 0, 0].amax(1)
    return result.reshape(shape)


def overlaps(largest: Tensor, mask: Tensor, levels: Tensor) -> Tensor:
    """IoU of a mask [H, W] with what has a vote [H, W] of at least each level [K]: [K].

    1 where both are empty.
    """
    shown = mask >= 0.5
    # Counted from the highest vote down, so that each level is one look-up
    order, known = largest.flatten().sort()
    first = torch.searchsorted(order, levels)
    after = torch.cat([shown.flatten()[known].flip(0).cumsum(0).flip(0), torch.zeros(1).long()])
    both, hull = after[first], len(order) - first
    either = hull + shown.sum() - both
    return torch.where(either > 0, both / either.clamp_min(1), 1.0)


def shrunk(mask: Tensor, pixels: int) -> Tensor:
    """A mask [H, W] whose longer side has at most so many pixels: means of its pixels."""
    share = min(1.0, pixels / max(mask.shape))
    height, width = (max(1, round(share * n)) for n in mask.shape)
    return interpolate(mask[None, None], (height, width), mode="area")[0, 0]


def _mended(
    mask: Tensor, silhouette: Tensor, hull: Hull, cameras: Cameras, view: int, cfg: VoteConfig
) -> Tensor:
    """The mask within the grown silhouette, and all of the shrunk one; borders one voxel soft.

    In the band between both the mask is believed where it ends there, full on the inner side and
    empty on the outer one. Elsewhere, as where the table goes on, the silhouette is.
    """
    centre = (torch.stack(hull.grid.bounds()).sum(0) / 2)[None]
    depth = project(cameras, view, centre)[1].abs()
    scale = silhouette.shape[1] / cameras.size(view)[0]
    voxel = float(hull.grid.voxel_size * cameras.focal[view].mean() * scale / depth)  # pixels
    small = shrunk(mask, cfg.pixels)
    away = mask_distances(silhouette.float()[None])[0] / voxel
    kernel = 2 * max(1, round(2 * BAND * voxel)) + 1
    sides = [(side >= BAND) & (side <= 3 * BAND) for side in (-away, away)]
    inner, outer = (_mean_near(small, side, kernel) for side in sides)
    believed = ((inner - outer - 0.5) / 0.25).clamp(0, 1)
    shape = (mask.shape[0], mask.shape[1])
    fine = interpolate(torch.stack([away, believed])[None], shape, mode="bilinear")[0]
    grown, middle, core = (0.5 - fine[0] + s for s in (BAND, 0.0, -BAND))
    within = torch.maximum(torch.minimum(mask, grown.clamp(0, 1)), core.clamp(0, 1))
    return torch.lerp(middle.clamp(0, 1), within, fine[1])


def _grown(mask: Tensor) -> Tensor:
    """A mask [H, W] and the pixels that touch it."""
    return max_pool2d(mask.float()[None], 3, 1, 1)[0] > 0


def _mean_near(values: Tensor, where: Tensor, kernel: int) -> Tensor:
    """Means [H, W] of values over those pixels of a square around each that count; 0 if none do."""
    counted = torch.stack([values * where, where.float()])[None]
    total, count = avg_pool2d(counted, kernel, 1, kernel // 2)[0]
    return total / count.clamp_min(1e-6)
