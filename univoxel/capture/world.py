"""The world of a model: upright, around what the cameras look at, in a handy scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from univoxel.capture.model import Model, Placed, Points
from univoxel.data.shots import turn_to_z, up_direction

DISTANCE = 4.0  # median distance of the cameras from the origin, in the written world
FLIP = np.array([1.0, -1.0, -1.0])  # camera axes of COLMAP to those of `Cameras`


@dataclass(frozen=True)
class Similarity:
    """x -> scale * turn x + shift."""

    scale: float
    turn: np.ndarray  # [3, 3] rotation
    shift: np.ndarray  # [3]


def settle(images: Sequence[Placed]) -> tuple[Similarity, bool]:
    """What makes +Z up, puts the origin where cameras look, and the first camera at -Y.

    The first is the first of the sequence. Returns too whether the cameras say what is up; if not,
    the mean of their up directions is taken.
    """
    axes = np.stack([i.to_camera[:, :3].T * FLIP for i in images])
    centres = np.stack([i.centre for i in images])
    up = up_direction(axes[:, :, :2].swapaxes(1, 2))
    known = up is not None
    if up is None:
        mean = axes[:, :, 1].mean(0)
        up = mean / np.linalg.norm(mean) if np.linalg.norm(mean) > 1e-6 else np.array([0, 0, 1.0])
    turn = turn_to_z(up)
    middle = looked_at(centres, -axes[:, :, 2])
    away = turn @ (centres - middle).T
    if np.hypot(*away[:2, 0]) > 1e-9:
        angle = -np.pi / 2 - np.arctan2(away[1, 0], away[0, 0])
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ turn
    distance = float(np.median(np.linalg.norm(away, axis=0)))
    scale = DISTANCE / distance if distance > 0 else 1.0
    return Similarity(scale, turn, -scale * turn @ middle), known


def looked_at(centres: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The point [3] nearest to all optical axes: positions [V, 3] and unit directions [V, 3]."""
    across = np.eye(3) - directions[:, :, None] * directions[:, None]
    system = across.mean(0) + 1e-9 * np.eye(3)
    return np.linalg.solve(system, (across @ centres[:, :, None]).mean(0)[:, 0])


def moved(model: Model, by: Similarity) -> Model:
    """The same model in another world; errors stay, they are in pixels."""
    images = []
    for image in model.images:
        turn = image.to_camera[:, :3] @ by.turn.T
        shift = by.scale * image.to_camera[:, 3] - turn @ by.shift
        images.append(replace(image, to_camera=np.concatenate([turn, shift[:, None]], 1)))
    p = model.points
    position = by.scale * p.position @ by.turn.T + by.shift
    return Model(model.cameras, images, Points(p.number, position, p.color, p.error, p.tracks))
