"""Photographs of a textured object on a patterned floor in a furnished room, with known cameras.

Rays meet boxes, balls and the room by formula; colours are noise of several scales in space, so
that every corner has something to hold on to. Fast and plain: flat light, square pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from PIL import Image

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
SCALES = ((3.0, 0.5), (9.0, 0.3), (27.0, 0.2))  # cells a unit, and their weight


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
    w, h = view.width * samples, view.height * samples
    scale = view.focal * max(w, h)
    column, row = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
    local = np.stack([(column - w / 2) / scale, (h / 2 - row) / scale, -np.ones((h, w))], -1)
    direction = (local @ view.pose[:, :3].T).reshape(-1, 3)
    origin = np.broadcast_to(view.pose[:, 3], direction.shape)
    c, s = math.cos(turn), math.sin(turn)
    turned = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    own_origin, own_direction = origin @ turned.T, direction @ turned.T
    best, which = np.full(len(direction), np.inf), np.full(len(direction), -1)
    surfaces = [_box(*(np.array(x) for x in box)) for box in BOXES]
    surfaces += [_ball(np.array(centre), radius) for centre, radius in BALLS]
    for k, surface in enumerate(surfaces):
        if still and k not in OBJECT:
            continue
        own = k in OBJECT
        t = surface(own_origin if own else origin, own_direction if own else direction)
        nearer = t < best
        best[nearer], which[nearer] = t[nearer], k
    room = which < 0
    own = np.isin(which, OBJECT)
    if still:  # the pattern stands in the picture
        points = np.stack(
            [column.ravel() / scale * 2, row.ravel() / scale * 2, np.zeros(best.shape)], -1
        )
        points[own] = (own_origin + best[:, None] * own_direction)[own]
    else:
        best[room] = _inside(origin[room], direction[room])
        points = origin + best[:, None] * direction
        points[own] = (own_origin + best[:, None] * own_direction)[own]
    color = _noise(points + np.where(own, 50.0, 0.0)[:, None])
    picture = color.reshape(view.height, samples, view.width, samples, 3).mean((1, 3))
    mask = own.reshape(view.height, samples, view.width, samples).mean((1, 3))
    return (
        Image.fromarray((255 * picture + 0.5).astype(np.uint8)),
        Image.fromarray((255 * mask + 0.5).astype(np.uint8)),
    )


_TABLE = np.random.default_rng(3).random((len(SCALES), 32, 32, 32, 3), dtype=np.float32)


def _noise(points: np.ndarray) -> np.ndarray:
    color = np.zeros_like(points, dtype=np.float32)
    for table, (cells, weight) in zip(_TABLE, SCALES, strict=True):
        i, j, k = (np.floor(points * cells + 0.123).astype(np.int64) % 32).T
        color += weight * table[i, j, k]
    return color


def _box(lower: np.ndarray, upper: np.ndarray):
    def distance(origin, direction):
        with np.errstate(divide="ignore"):
            a, b = (lower - origin) / direction, (upper - origin) / direction
        near, far = np.minimum(a, b).max(1), np.maximum(a, b).min(1)
        return np.where((near < far) & (near > 0), near, np.inf)

    return distance


def _ball(centre: np.ndarray, radius: float):
    def distance(origin, direction):
        a, away = (direction**2).sum(1), origin - centre
        b = (away * direction).sum(1)
        root = b * b - a * ((away**2).sum(1) - radius**2)
        return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)

    return distance


def _inside(origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    lower, upper = np.array([-ROOM, -ROOM, 0.0]), np.array([ROOM, ROOM, 3.0])
    with np.errstate(divide="ignore"):
        return np.maximum((lower - origin) / direction, (upper - origin) / direction).min(1)
