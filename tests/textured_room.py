"""Photographs of a textured object on a patterned floor in a furnished room, with known cameras.

Rays meet boxes, balls and the room by formula; colours are noise of several scales in space, so
that every corner has something to hold on to. Fast and plain: flat light, square pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from univoxel.camera import Cameras
from univoxel.data.photos import Photos

RADIUS = 2.2  # of the orbit
ROOM = 4.0  # half of its width; the floor is at z = 0
BOXES = (  # lower corner, upper corner
    ((-0.35, -0.3, 0.0), (0.35, 0.3, 0.5)),  # the object's foot
    ((-3.9, -3.9, 0.0), (-2.6, -3.0, 1.6)),  # furniture
    ((2.7, -3.9, 0.0), (3.9, -2.8, 0.9)),
    ((2.9, 2.2, 0.0), (3.9, 3.9, 2.1)),
    ((-3.9, 1.5, 0.0), (-3.2, 3.5, 1.0)),
)
BALLS = (((0.0, 0.0, 0.75), 0.35), ((0.3, 0.2, 0.6), 0.18))  # the object's head
OBJECT = (0, len(BOXES), len(BOXES) + 1)  # indices of the surfaces that are the object's
BAND = 12  # rows of pixels at a time
SCALES = ((3.0, 0.5), (9.0, 0.3), (27.0, 0.2))  # cells a unit, and their weight
TABLES = np.random.default_rng(3).random((len(SCALES), 32, 32, 32, 3), dtype=np.float32)


@dataclass(frozen=True)
class View:
    pose: np.ndarray  # [3, 4] camera-to-world; x right, y up, looking along -z
    focal: float  # of the longer side
    width: int
    height: int


def orbit(views: int, width: int = 480, height: int = 360, focal: float = 1.0) -> list[View]:
    """Cameras all around at two heights, which look at the object."""
    found = []
    for v in range(views):
        phi, up = 2 * math.pi * v / views + 0.05 * (v % 3), math.radians((20, 38)[v % 2])
        place = RADIUS * np.array(
            [math.cos(phi) * math.cos(up), math.sin(phi) * math.cos(up), math.sin(up)]
        )
        target = np.array([0.0, 0.0, 0.45])
        found.append(View(look_at(place + target, target), focal, width, height))
    return found


def cameras(views: list[View]) -> Cameras:
    """Those of views whose pictures are of one size."""
    width, height = views[0].width, views[0].height
    return Cameras(
        torch.tensor(np.stack([seen.pose for seen in views])).float(),
        torch.tensor([2 * [seen.focal * max(width, height)] for seen in views]),
        torch.tensor([[width / 2, height / 2]] * len(views)),
        *(width, height),
    )


def look_at(place: np.ndarray, target: np.ndarray) -> np.ndarray:
    back = (place - target) / np.linalg.norm(place - target)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back, place], 1)


def photograph(
    view: View, samples: int = 2, turn: float = 0.0, still: bool = False
) -> tuple[Image.Image, Image.Image]:
    """The picture and the object's mask.

    Args:
        samples: along each side of a pixel.
        turn: of the object on its foot about +Z, radians.
        still: room and floor move with the camera, as where the object stands on a turntable; the
            background is then far away and has a pattern in the picture.
    """
    bands = [
        _band(view, samples, turn, still, first, min(first + BAND, view.height))
        for first in range(0, view.height, BAND)
    ]
    color, mask = (np.concatenate(parts) for parts in zip(*bands, strict=True))
    return (
        Image.fromarray((255 * color + 0.5).astype(np.uint8)),
        Image.fromarray((255 * mask + 0.5).astype(np.uint8)),
    )


def photos_of(views: list[View], folder: Path | None = None) -> Photos:
    """Their photographs v0, v1, ... with the object's masks."""
    color, masks = (
        torch.from_numpy(np.stack(pictures))
        for pictures in zip(*map(photograph, views), strict=True)
    )
    return Photos(folder, [f"v{i}" for i in range(len(views))], color, masks, cameras(views))


def _band(
    view: View, samples: int, turn: float, still: bool, first: int, end: int
) -> tuple[np.ndarray, np.ndarray]:
    """Colour [R, W, 3] and mask [R, W] of some rows of pixels: what fits into the cache."""
    origin, direction, local = _rays(view, samples, first, end)
    count = direction.shape[1]
    c, s = math.cos(turn), math.sin(turn)
    turned = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    rays = (origin, direction), (turned @ origin, turned @ direction)
    best, which = np.full(count, np.inf), np.full(count, -1)
    boxes = [(_box, np.array(low)[:, None], np.array(high)[:, None]) for low, high in BOXES]
    balls = [(_ball, np.array(centre)[:, None], radius) for centre, radius in BALLS]
    for k, (distance, *shape) in enumerate(boxes + balls):
        if still and k not in OBJECT:
            continue
        t = distance(*shape, *rays[k in OBJECT])
        nearer = t < best
        best[nearer], which[nearer] = t[nearer], k
    own = np.isin(which, OBJECT)
    room = which < 0
    if still:  # the pattern stands in the picture
        points = 2 * local * np.array([[1.0], [-1.0], [0.0]])
    else:
        best[room] = _inside(origin, direction[:, room])
        points = origin + best * direction
    points[:, own] = (rays[1][0] + best[own] * rays[1][1][:, own]) + 50.0
    shape = (end - first, samples, view.width, samples)
    color = noise(points).reshape(*shape, 3)
    return color.mean((1, 3)), own.reshape(shape).mean((1, 3))


def _rays(view: View, samples: int, first: int, end: int) -> tuple[np.ndarray, ...]:
    """Origin [3, 1] and directions [3, N] of samples of some rows, and these in the camera."""
    w, h = view.width * samples, view.height * samples
    scale = view.focal * max(w, h)
    row, column = np.mgrid[first * samples : end * samples, :w].reshape(2, -1) + 0.5
    local = np.stack([(column - w / 2) / scale, (h / 2 - row) / scale, -np.ones(len(row))])
    return view.pose[:, 3:], view.pose[:, :3] @ local, local


def distance(view: View) -> np.ndarray:
    """Along each pixel's ray to what it shows: [H, W] float32."""
    origin, direction, _ = _rays(view, 1, 0, view.height)
    boxes = [_box(*(np.array(x)[:, None] for x in box), origin, direction) for box in BOXES]
    balls = [_ball(np.array(c)[:, None], r, origin, direction) for c, r in BALLS]
    near = np.minimum.reduce([*boxes, *balls, _inside(origin, direction)])
    distance = near * np.linalg.norm(direction, axis=0)
    return distance.reshape(view.height, view.width).astype(np.float32)


def noise(points: np.ndarray) -> np.ndarray:
    """Colours [N, 3] in [0, 1] of points [3, N]."""
    color = np.zeros((points.shape[1], 3), np.float32)
    for table, (cells, weight) in zip(TABLES, SCALES, strict=True):
        i, j, k = np.floor(points * cells + 0.123).astype(np.int64) % 32
        color += weight * table[i, j, k]
    return color


def _box(lower, upper, origin, direction) -> np.ndarray:
    with np.errstate(divide="ignore"):
        a, b = (lower - origin) / direction, (upper - origin) / direction
    near, far = np.minimum(a, b).max(0), np.maximum(a, b).min(0)
    return np.where((near < far) & (near > 0), near, np.inf)


def _ball(centre, radius, origin, direction) -> np.ndarray:
    a, away = (direction**2).sum(0), origin - centre
    b = (away * direction).sum(0)
    root = b * b - a * ((away**2).sum() - radius**2)
    return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)


def _inside(origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    lower, upper = np.array([[-ROOM, -ROOM, 0.0], [ROOM, ROOM, 3.0]])[..., None]
    with np.errstate(divide="ignore"):
        return np.maximum((lower - origin) / direction, (upper - origin) / direction).min(0)
