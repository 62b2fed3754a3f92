"""Rough masks: their edges are moved to where the object's colours end and those around it begin.

A pixel near the edge looks like what is surely the object, further in, or like what surely is not,
further out. Where both are alike nothing tells, and the mask stays about as it is.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.linalg import cg
from scipy.spatial import KDTree
from torch import Tensor

from univoxel import memmap
from univoxel.data import Photos
from univoxel.data.base import coverage_of
from univoxel.preparation.masks import as_srgb, cut_away
from univoxel.threads import side_by_side

# Share of a picture's larger side by which edges are moved at most
MOST = 0.04
# Pixels beyond what a mask may be off by, in which colours of the object and of what is around
# are taken
SAMPLES_WITHIN = 6.0
# How many times so far a pixel may be from the nearest of these: others say nothing
KNOWN_WITHIN = 2.0
# Colours of the object that a pixel is compared with, the nearest ones: it has patterns
OBJECT_SAMPLES = 200
# The same of what is around
OTHER_SAMPLES = 24
# Pixels that a mask may be off by, for each pixel between the colours that are taken: of a wide
# band fewer are enough, for time
SPACING = 3.0
# sRGB that colours of one thing differ by
NOISE = 0.06
# How much colours count that tell clearly
COLORS = 4.0
# How much the mask counts
GIVEN = 0.5
# How much a neighbour of the same colour counts
SMOOTH = 3.0
# How many times steeper the edge is made than the equations for it leave it: they draw it out
STEEPER = 3.0


def drawn_again(
    photos: Photos,
    distance: Tensor,
    off: float,
    doubted: Tensor,
) -> Tensor:
    """Coverage [V, H, W] in [0, 1] by masks whose edges lie where colours change.

    Photographs of which nothing but the object is left keep theirs.

    Args:
        distance: [V, H, W] from `hull.mask_distances`.
        off: pixels, > 0, that edges may be off by; at most MOST are moved.
        doubted: [V, H, W] bool, where a mask is not believed at all: it stays, and tells nothing.
    """
    coverage, cut = memmap.zeros(photos.alpha.shape, torch.float32), photos.cameras.cut

    def draw_(view: int) -> None:
        coverage[view] = coverage_of(photos.alpha[view])
        color, covered = as_srgb(photos.stored(view)[0]), cut(view, coverage[view])
        away = cut(view, distance[view])
        if shows_nothing_else(photos, distance, view):
            return
        reach = min(off, MOST * max(covered.shape))
        believed = ~cut(view, doubted[view]).numpy()
        picture, mask, far = (x.numpy().astype(np.float64) for x in (color, covered, away))
        covered.copy_(torch.from_numpy(outlined(picture, mask, far, believed, reach)))

    side_by_side(draw_, range(len(photos)))
    return coverage


def shows_nothing_else(photos: Photos, distance: Tensor, view: int) -> bool:
    """Whether nothing but the object is left of a photograph.

    Args:
        distance: [V, H, W] from `hull.mask_distances`.
    """
    color, stored = photos.stored(view)
    away = photos.cameras.cut(view, distance[view])
    return cut_away(as_srgb(color), coverage_of(stored), away)


def outlined(
    color: np.ndarray,
    coverage: np.ndarray,
    distance: np.ndarray,
    believed: np.ndarray,
    reach: float,
) -> np.ndarray:
    """Coverage [H, W] in [0, 1] by a mask whose edge is moved, at most `reach` pixels.

    Args:
        color: [H, W, 3] sRGB, in [0, 1].
        coverage, distance, believed: [H, W], of the mask.

    Source: the equations are those of Grady 2005, "Multilabel Random Walker Image Segmentation
    Using Prior Models".
    """
    ring = reach + SAMPLES_WITHIN
    band = (np.abs(distance) <= reach) & believed
    inside, around = (believed & (d > reach) & (d <= ring) for d in (-distance, distance))
    if not (band.any() and inside.any() and around.any()):
        return coverage
    apart = max(1, int(reach / SPACING))
    share, tells = _likeness(color, band, inside, around, apart, KNOWN_WITHIN * ring)
    return _smoothed(color, coverage, band, share, COLORS * tells)


def _likeness(
    color: np.ndarray,
    band: np.ndarray,
    inside: np.ndarray,
    around: np.ndarray,
    apart: int,
    known_within: float,
) -> tuple[np.ndarray, np.ndarray]:
    """How much pixels of the band [N] look like the object rather than like what is around, and
    how clearly; both in [0, 1]. Colours of either side are taken so many pixels apart, >= 1."""
    pixels, colors = np.argwhere(band), color[band]
    unlike, known = [], np.ones(len(pixels), bool)
    for side, most in ((inside, OBJECT_SAMPLES), (around, OTHER_SAMPLES)):
        places = np.argwhere(side)
        fewer = places[(places % apart == 0).all(1)]
        places = fewer if len(fewer) else places
        count = min(max(1, most // apart**2), len(places))
        found = KDTree(places).query(pixels, k=count)
        away, index = (np.asarray(x).reshape(-1, count) for x in found)  # of one sample it is [N]
        unlike.append(_least_difference(colors, color[tuple(places.T)], index))
        known &= away[:, 0] <= known_within
    tells = (unlike[1] - unlike[0]) / (2 * NOISE)
    share = 1 / (1 + np.exp(-4 * tells.clip(-10, 10)))
    return share, np.where(known, np.minimum(np.abs(tells), 1) ** 2, 0)


def _least_difference(colors: np.ndarray, samples: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Of colours [N, 3], to the most alike of samples [S, 3] of their own [N, K]: [N]."""
    least = np.full(len(colors), np.inf)
    for column in index.T:  # [N, K, 3] would be large
        least = np.minimum(least, ((colors - samples[column]) ** 2).sum(1))
    return np.sqrt(least)


def _smoothed(
    color: np.ndarray,
    given: np.ndarray,
    band: np.ndarray,
    share: np.ndarray,
    weight: np.ndarray,
) -> np.ndarray:
    """Coverage [H, W] that follows shares [N] of the band, by weights, and the mask, and changes
    where colours do."""
    index = np.full(band.shape, -1)
    index[band] = np.arange(len(share))
    pixels = np.argwhere(band)
    diagonal, right = weight + GIVEN, weight * share + GIVEN * given[band]
    rows, columns, entries = [], [], []
    for step in ((0, 1), (1, 0), (0, -1), (-1, 0)):
        beside = pixels + step
        here = np.flatnonzero(((beside >= 0) & (beside < band.shape)).all(1))
        own, other = tuple(pixels[here].T), tuple(beside[here].T)
        unlike = ((color[own] - color[other]) ** 2).sum(-1) / (2 * NOISE**2)
        alike = SMOOTH * np.exp(-unlike)
        there = index[other]
        fixed = there < 0  # beyond the band, where the mask stays
        diagonal[here] += alike
        right[here[fixed]] += alike[fixed] * given[other][fixed]
        rows.append(here[~fixed])
        columns.append(there[~fixed])
        entries.append(-alike[~fixed])
    places = np.concatenate(rows), np.concatenate(columns)
    matrix = sparse.csr_matrix((np.concatenate(entries), places), shape=2 * share.shape)
    system = matrix + sparse.diags(diagonal, format="csr")
    # Well conditioned, since each pixel has a say of its own: some tens of products are enough
    found, _ = cg(system, right, given[band], rtol=1e-4, M=sparse.diags(1 / diagonal))
    result = given.copy()
    result[band] = ((found - 0.5) * STEEPER + 0.5).clip(0, 1)
    return result
