"""Points matched between neighbouring photographs, and the epipolar error of the cameras."""

from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from skimage.feature import SIFT, match_descriptors
from skimage.measure import ransac
from skimage.transform import FundamentalMatrixTransform
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from univoxel.camera import Cameras, looked_at, projection_matrices
from univoxel.color import linear_to_srgb
from univoxel.data import Photos

# Pairs of neighbouring photographs that are compared, at most: a second or two for each four of
# them
PAIRS = 16
# Pixels along the longer side of what is searched: larger photographs are shrunk, for time
LONGEST = 640
# Pixels along the longer side up to which they are searched at twice their size
SMALL = 320
# Radii of a keypoint that it lies inside of the silhouette: outlines move over a surface
CLEAR = 2.0
# Difference of the best match over that of the second best: above it, it is a guess
RATIO = 0.75
# Matches of a pair that a fundamental matrix has to explain together: eight make one
FITTED = 16
# Pixels that a match may be off by what that matrix says
RESIDUAL = 1.0
# Matrices that are tried
TRIALS = 200
# Matches in all below which nothing is known: plain objects
MIN_MATCHES = 60


AROUND = 8  # pixels around the object in which its keypoints are described


@dataclass(frozen=True)
class Matches:
    """N points of the object, each seen in two photographs."""

    views: Tensor  # [N, 2] int64
    first: Tensor  # [N, 2] pixels in the first of them
    second: Tensor  # [N, 2] in the second

    def __len__(self) -> int:
        return len(self.views)


@dataclass(frozen=True)
class Agreement:
    """How far matched points lie from where the cameras put them, pixels."""

    median: float
    most: float  # of 90 % of them
    matches: int


def agreement(cameras: Cameras, matches: Matches) -> Agreement | None:
    """How far matches lie from their epipolar lines; None: there are too few to tell."""
    if len(matches) < MIN_MATCHES:
        return None
    distance = epipolar_distances(cameras, matches)
    median, most = distance.quantile(torch.tensor([0.5, 0.9], dtype=distance.dtype)).tolist()
    return Agreement(median, most, len(matches))


def epipolar_distances(cameras: Cameras, matches: Matches) -> Tensor:
    """Pixels [N] between points and the lines on which the other view's camera puts them, in the
    mean over both views; float64.

    Source: Hartley and Zisserman 2004, "Multiple View Geometry in Computer Vision", 9.2 and 11.4.
    """
    matrix = projection_matrices(cameras).double()
    centre = cameras.camera_to_world[:, :, 3].double()
    first, second = matches.views.unbind(1)
    points = [_homogeneous(x) for x in (matches.first, matches.second)]
    lines = [
        _epipolar_lines(matrix, centre, from_, x, onto)
        for from_, x, onto in ((second, points[1], first), (first, points[0], second))
    ]
    apart = [
        (x * line).sum(1).abs() / line[:, :2].norm(dim=1).clamp_min(1e-12)
        for x, line in zip(points, lines, strict=True)
    ]
    return (apart[0] + apart[1]) / 2


def _epipolar_lines(
    matrix: Tensor, centre: Tensor, from_: Tensor, points: Tensor, onto: Tensor
) -> Tensor:
    """The lines [N, 3] in views `onto` [N] of the rays through points [N, 3] of views `from_`."""
    away = torch.linalg.solve(matrix[from_, :, :3], points[..., None])  # along the ray
    at_infinity = (matrix[onto, :, :3] @ away)[..., 0]
    origin = _homogeneous(centre[from_])[..., None]
    return torch.linalg.cross((matrix[onto] @ origin)[..., 0], at_infinity)


def _homogeneous(x: Tensor) -> Tensor:
    return torch.cat([x.double(), torch.ones(len(x), 1, dtype=torch.float64)], 1)


def find_matches(photos: Photos, distance: Tensor) -> Matches:
    """Points that are found again in the nearest views.

    What the cameras say chooses which views are neighbours, and nothing else: matches stay that a
    fundamental matrix explains together with others of their pair. Where these are too few, all
    stay: a wrong match makes cameras look wrong, never right.

    Args:
        distance: [V, H, W] from `hull.mask_distances`: what is no object, and what has the
            object's outline in it, is left out.

    Source: Lowe 2004, "Distinctive Image Features from Scale-Invariant Keypoints".
    """
    pairs = neighbours(photos.cameras)
    views = sorted({view for pair in pairs for view in pair})
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        found = dict(
            zip(views, pool.map(lambda v: _keypoints(photos, distance, v), views), strict=True)
        )
    matched = [_matched(found[a], found[b]) for a, b in pairs]
    count = torch.tensor([len(m) for m, _ in matched])
    points = torch.from_numpy(np.concatenate([np.zeros((0, 4)), *(m for m, _ in matched)]))
    of = torch.tensor(pairs).reshape(-1, 2).repeat_interleave(count, 0)
    explained = torch.from_numpy(np.concatenate([np.zeros(0, bool), *(e for _, e in matched)]))
    if explained.sum() >= MIN_MATCHES:
        points, of = points[explained], of[explained]
    return Matches(of, points[:, :2], points[:, 2:])


def neighbours(cameras: Cameras) -> list[tuple[int, int]]:
    """Pairs of a view and the one that sees the object from the nearest direction, PAIRS at
    most: of views as evenly spread among all as they go."""
    away = normalize(cameras.camera_to_world[:, :, 3] - looked_at(cameras), dim=1)
    cosine = (away @ away.T).fill_diagonal_(-math.inf)
    step = max(1.0, len(cameras) / PAIRS)
    views = [int(k * step) for k in range(min(PAIRS, len(cameras)))]
    nearest = cosine.argmax(1)
    pairs = [(view, int(nearest[view])) for view in views if len(cameras) > 1]
    return sorted({(min(pair), max(pair)) for pair in pairs})


def _keypoints(photos: Photos, distance: Tensor, view: int) -> tuple[np.ndarray, np.ndarray]:
    """Places [K, 2], pixels, and descriptors [K, 128] of keypoints on the object."""
    none = np.zeros((0, 2)), np.zeros((0, 128), np.uint8)
    depth = photos.cameras.cut(view, distance[view])
    rows, columns = ((depth < 0).any(axis).nonzero()[:, 0] for axis in (1, 0))
    if not len(rows):
        return none
    top, left = (max(int(x.min()) - AROUND, 0) for x in (rows, columns))
    color = photos.stored(view)[0][
        top : int(rows.max()) + 1 + AROUND, left : int(columns.max()) + 1 + AROUND
    ]
    encoded = color.float() / 255 if color.dtype == torch.uint8 else linear_to_srgb(color)
    grey = encoded.mean(-1)
    share = min(1.0, LONGEST / max(grey.shape))
    if share < 1:
        size = tuple(max(1, round(n * share)) for n in grey.shape)
        grey = interpolate(grey[None, None], size, mode="bilinear", antialias=True)[0, 0]
    # Details of a pixel or two count where there are few pixels
    sift = SIFT(upsampling=2 if max(grey.shape) <= SMALL else 1)
    try:
        sift.detect_and_extract(grey.double().numpy())
    except (RuntimeError, ValueError):  # no keypoints, or fewer pixels than filters need
        return none
    scale = np.array([color.shape[1], color.shape[0]]) / np.array(grey.shape[::-1])
    positions, sigmas, descriptors = (
        np.asarray(found) for found in (sift.positions, sift.sigmas, sift.descriptors)
    )
    place = (positions[:, ::-1] + 0.5) * scale + np.array([left, top])
    column, row = np.floor(place).astype(int).T
    inside = depth.numpy()[row.clip(0, depth.shape[0] - 1), column.clip(0, depth.shape[1] - 1)]
    clear = inside < -CLEAR * sigmas * scale.mean()
    return place[clear], descriptors[clear]


def _matched(
    one: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Places [M, 4] of points in two photographs that look alike, and which of them [M] a
    fundamental matrix explains."""
    if min(len(one[0]), len(other[0])) < 2:  # a ratio needs a second best
        return np.zeros((0, 4)), np.zeros(0, bool)
    index = match_descriptors(one[1], other[1], max_ratio=RATIO, cross_check=True)
    first, second = one[0][index[:, 0]], other[0][index[:, 1]]
    explained = np.zeros(len(index), bool)
    if len(index) >= FITTED:
        _, inlier = ransac(
            (first, second),
            FundamentalMatrixTransform,
            min_samples=8,
            residual_threshold=RESIDUAL,
            max_trials=TRIALS,
            rng=0,
        )
        if inlier is not None and np.sum(inlier) >= FITTED:
            explained = np.asarray(inlier, bool)
    return np.concatenate([first, second], 1), explained
