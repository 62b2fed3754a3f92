"""Gaps that few masks see through, taken out of a hull that the others filled.

Between cups on a tray, or under an arch, only pictures from the side see what stands behind. They
are outvoted, although they are right. A mask that lost a part of the object looks the same in its
own picture, but not in those of others: without that part they have something that nothing covers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage
from skimage.measure import label
from torch import Tensor
from torch.nn.functional import interpolate

from univoxel.bars import track
from univoxel.camera import Cameras, project
from univoxel.grid import GridShape

# Gaps are what few masks see through, and a vote fills. Voxels, of the pixels in which they are
# looked for
GAP_PIXEL = 1.5
# Share of the silhouette's area that a gap has at least
SMALLEST_GAP = 0.002
# Rounds through all photographs, at most; one gap may open the next
GAP_ROUNDS = 3


@dataclass(frozen=True)
class _Sight:
    """What a picture sees of the hull's nodes, in pixels that are wider than a voxel."""

    shown: np.ndarray  # [H, W] the mask
    pixel: np.ndarray  # [N] uint32, of each node: row W + column; H W beside the picture
    nodes: np.ndarray  # [H W + 1] how many nodes each pixel has; the last is for those beside


def carve_gaps_(
    vote: Tensor,
    threshold: float,
    masks: Sequence[Tensor],
    cameras: Cameras,
    grid: GridShape,
) -> int:
    """Take votes [X, Y, Z] away where a mask [H, W] sees through; return of how many nodes.

    The hull, nodes of at least the threshold, loses what lies behind a gap of a mask if masks and
    silhouettes of all pictures together then differ in fewer pixels than before.
    """
    inside = vote >= threshold
    nodes = grid.nodes()[inside]
    sights = [_sight(nodes, cameras, v, mask, grid) for v, mask in enumerate(masks)]
    kept = np.ones(len(nodes), bool)
    for _ in range(GAP_ROUNDS):
        before = kept.sum()
        for one in track(sights, "looking through gaps"):
            for gap in _gaps(one):
                gone = kept & gap[one.pixel]
                if gone.any() and _agrees(sights, gone):
                    kept &= ~gone
                    for other in sights:
                        other.nodes[:] -= _count(other, gone)
        if kept.sum() == before:
            break
    vote[inside] = torch.where(torch.from_numpy(kept), vote[inside], 0.0)
    return int((~kept).sum())


def _sight(nodes: Tensor, cameras: Cameras, view: int, mask: Tensor, grid: GridShape) -> _Sight:
    where, depth = project(cameras, view, nodes)
    near = depth[depth > 0].median() if (depth > 0).any() else torch.ones(())
    wide = GAP_PIXEL * grid.voxel_size * float(cameras.focal[view].max() / near)
    size = cameras.size(view)
    width, height = (
        min(of_mask, max(1, round(n / wide)))
        for n, of_mask in zip(size, reversed(mask.shape), strict=True)
    )
    column, row = (where * torch.tensor([width / size[0], height / size[1]])).floor().unbind(1)
    seen = (depth > 0) & (row >= 0) & (row < height) & (column >= 0) & (column < width)
    pixel = torch.where(seen, row * width + column, height * width).numpy().astype(np.uint32)
    small = interpolate(mask[None, None], (height, width), mode="area")[0, 0]
    return _Sight(small.numpy() >= 0.5, pixel, np.bincount(pixel, minlength=height * width + 1))


def _gaps(sight: _Sight) -> list[np.ndarray]:
    """Parts of the silhouette [H W + 1], largest first, that the mask sees through."""
    silhouette = sight.nodes[:-1].reshape(sight.shown.shape) > 0
    through = silhouette & ~np.asarray(ndimage.binary_dilation(sight.shown), bool)
    parts = np.asarray(label(through, connectivity=1))
    area = np.bincount(parts.ravel())
    area[0] = 0
    order = np.argsort(-area)
    large = order[area[order] >= max(1, SMALLEST_GAP * silhouette.sum())]
    flat = np.append(parts.ravel(), 0)
    return [flat == part for part in large]


def _count(sight: _Sight, some: np.ndarray) -> np.ndarray:
    """How many of some nodes [N] each pixel has: [H W + 1]."""
    return np.bincount(sight.pixel[some], minlength=len(sight.nodes))


def _agrees(sights: Sequence[_Sight], gone: np.ndarray) -> bool:
    """Whether masks and silhouettes differ in fewer pixels without some nodes [N]."""
    better = 0
    for one in sights:
        count = _count(one, gone)
        empty = ((count > 0) & (count == one.nodes))[:-1]
        shown = one.shown.ravel()[empty]
        better += len(shown) - 2 * int(shown.sum())
    return better > 0
