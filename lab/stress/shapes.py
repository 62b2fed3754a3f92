"""Objects of known shape and material, as triangles around signed distances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from skimage.measure import marching_cubes

Triple: TypeAlias = tuple[float, float, float]
Distance: TypeAlias = Callable[[np.ndarray], np.ndarray]  # points [..., 3] to signed distance [...]
Pattern: TypeAlias = Callable[[np.ndarray], np.ndarray]  # points [..., 3] to base colour [..., 3]

SPACING = 0.0125  # of the grid that surfaces are marched on, world units
SHAPES = ("figure", "box", "rods", "fur")
FUR_RADIUS = 0.55  # of the ball under the fur, world units
HAIRS = 6000
HAIR_RADIUS = 0.006  # at the root, world units: half of a pixel


@dataclass(frozen=True)
class Part:
    """A closed piece; what is one number is the same all over it."""

    vertices: np.ndarray  # [P, 3] float32, world units
    faces: np.ndarray  # [F, 3] int32, counter-clockwise seen from outside
    normals: np.ndarray  # [P, 3] float32 unit
    base: np.ndarray  # [P, 3] float32 linear base colour
    roughness: float | np.ndarray  # perceptual, in (0, 1]; or [P] float32
    metallic: float | np.ndarray = 0.0  # in [0, 1]; or [P] float32


def build(shape: str, amount: float, roughness: float, metals: int) -> list[Part]:
    """The parts of an object, about the origin and within a ball of radius 0.92.

    Args:
        shape: "figure", a ball on a rounded box, a ring around its foot; "box", an open box of
            width 0.9 with coloured walls and a ball in it; "rods", two plates with a ball and
            rods between them; "fur", a ball with hairs.
        amount: depth of the box, diameter of the rods, or length of the hairs; the figure has none.
        roughness: of all parts.
        metals: how many parts are metal, the smallest first.

    Raises:
        ValueError: there is no such shape.
    """
    match shape:
        case "figure":
            parts = _figure(roughness)
        case "box":
            parts = _box(amount, roughness)
        case "rods":
            parts = _rods(amount, roughness)
        case "fur":
            parts = _fur(amount, roughness)
        case _:
            raise ValueError(f"shape must be of {', '.join(SHAPES)}, got {shape!r}")
    return [replace(p, metallic=1.0) if i < metals else p for i, p in enumerate(parts)]


def ball(radius: float) -> Distance:
    return lambda p: np.linalg.norm(p, axis=-1) - radius


def ring(radius: float, tube: float) -> Distance:
    """A torus about z."""

    def distance(p: np.ndarray) -> np.ndarray:
        across = np.linalg.norm(p[..., :2], axis=-1) - radius
        return np.hypot(across, p[..., 2]) - tube

    return distance


def rounded_box(half: Triple, rounding: float) -> Distance:
    def distance(p: np.ndarray) -> np.ndarray:
        q = np.abs(p) - (np.array(half) - rounding)
        outside = np.linalg.norm(np.maximum(q, 0), axis=-1)
        return outside + np.minimum(q.max(-1), 0) - rounding

    return distance


def rod(radius: float, half: float) -> Distance:
    """A rod along z with round ends; `half` its length without them."""

    def distance(p: np.ndarray) -> np.ndarray:
        z = p[..., 2] - np.clip(p[..., 2], -half, half)
        return np.sqrt((p[..., :2] ** 2).sum(-1) + z**2) - radius

    return distance


def surface(
    distance: Distance, half: Triple, spacing: Triple
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices [P, 3], faces [F, 3] and unit normals [P, 3] of a zero set inside [-half, half]."""
    counts = [int(np.ceil(h / s)) + 2 for h, s in zip(half, spacing, strict=True)]
    axes = [s * np.arange(-n, n + 1) for n, s in zip(counts, spacing, strict=True)]
    values = distance(np.stack(np.meshgrid(*axes, indexing="ij"), -1))
    found = marching_cubes(values, 0.0, spacing=spacing)
    vertices = found[0] - np.array(counts) * np.array(spacing)
    normals = gradient(distance, vertices)
    vertices = vertices - distance(vertices)[:, None] * normals
    return vertices, found[1], gradient(distance, vertices)


def gradient(distance: Distance, points: np.ndarray, step: float = 1e-4) -> np.ndarray:
    """Unit gradient [P, 3] of a distance at points [P, 3]."""
    steps = step * np.eye(3)
    found = np.stack([distance(points + s) - distance(points - s) for s in steps], -1)
    return found / np.maximum(np.linalg.norm(found, axis=-1, keepdims=True), 1e-12)


def _part(
    distance: Distance,
    half: Triple,
    pattern: Pattern,
    roughness: float,
    centre: Triple = (0, 0, 0),
    turn: np.ndarray | None = None,  # [3, 3] local to world
    spacing: Triple = (SPACING, SPACING, SPACING),
) -> Part:
    """A piece given in coordinates of its own; its colour follows from those."""
    vertices, faces, normals = surface(distance, half, spacing)
    base = pattern(vertices)
    if turn is not None:
        vertices, normals = vertices @ turn.T, normals @ turn.T
    world = vertices + np.array(centre)
    return Part(
        world.astype(np.float32),
        faces.astype(np.int32),
        normals.astype(np.float32),
        base.astype(np.float32),
        roughness,
    )


def _figure(roughness: float) -> list[Part]:
    return [
        _part(ring(0.34, 0.08), (0.42, 0.42, 0.08), _striped, roughness, (0, 0, -0.11)),
        _part(ball(0.38), (0.38, 0.38, 0.38), _swirl, roughness, (0, 0, 0.19)),
        _part(
            rounded_box((0.46, 0.46, 0.2), 0.05),
            (0.46, 0.46, 0.2),
            _checked,
            roughness,
            (0, 0, -0.39),
        ),
    ]


def _box(depth: float, roughness: float) -> list[Part]:
    wall, width = 0.05, 0.45
    half = wall + depth / 2
    outer = rounded_box((width + wall, width + wall, half), 0.015)
    inner = rounded_box((width, width, half), 0.015)

    def distance(p: np.ndarray) -> np.ndarray:
        return np.maximum(outer(p), -inner(p - np.array([0, 0, 2 * wall])))

    return [
        _part(ball(0.2), (0.2, 0.2, 0.2), _swirl, roughness, (0.12, -0.1, 2 * wall - half + 0.2)),
        _part(distance, (width + wall, width + wall, half), _walls, roughness),
    ]


def _rods(diameter: float, roughness: float) -> list[Part]:
    plate = rounded_box((0.5, 0.5, 0.06), 0.03)
    parts = [_part(ball(0.26), (0.26, 0.26, 0.26), _swirl, roughness)]
    parts += [_part(plate, (0.5, 0.5, 0.06), _checked, roughness, (0, 0, z)) for z in (-0.5, 0.5)]
    radius = diameter / 2
    for k in range(6):  # a cage of leaning rods
        low, high = (
            np.array([0.4 * np.cos(a), 0.4 * np.sin(a), z])
            for a, z in ((k * np.pi / 3, -0.46), (k * np.pi / 3 + 0.6, 0.46))
        )
        axis = (high - low) / np.linalg.norm(high - low)
        side = np.cross(axis, [1.0, 0, 0])
        side /= np.linalg.norm(side)
        turn = np.stack([np.cross(side, axis), side, axis], 1)
        half = float(np.linalg.norm(high - low)) / 2
        parts.append(
            _part(
                rod(radius, half),
                (radius, radius, half + radius),
                _banded,
                roughness,
                _triple((low + high) / 2),
                turn,
                (diameter / 10, diameter / 10, 0.02),
            )
        )
    return parts


def _fur(length: float, roughness: float) -> list[Part]:
    """A ball with hairs thinner than a pixel, each of the ball's colour at its root."""
    skin = _part(ball(FUR_RADIUS), (FUR_RADIUS, FUR_RADIUS, FUR_RADIUS), _swirl, roughness)
    if not length:
        return [skin]
    z, turn = 1 - (2 * np.arange(HAIRS) + 1) / HAIRS, np.arange(HAIRS) * np.pi * (3 - np.sqrt(5))
    out = np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], -1)
    # They lean by up to 37 degrees, each its own way and most of them down
    lean = np.random.default_rng(0).normal(size=(HAIRS, 3)) + np.array([0.0, 0.0, -0.7])
    axis = out + 0.6 * lean / np.linalg.norm(lean, axis=1, keepdims=True)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    root = FUR_RADIUS * out
    vertices, normals, faces = cones(root - 0.03 * axis, axis, length + 0.03, HAIR_RADIUS)
    base = np.broadcast_to(_swirl(root)[:, None], vertices.shape)
    vertices, normals, base = (
        x.reshape(-1, 3).astype(np.float32) for x in (vertices, normals, base)
    )
    return [skin, Part(vertices, faces.reshape(-1, 3), normals, base, roughness)]


def cones(
    root: np.ndarray, axis: np.ndarray, length: float, radius: float, sides: int = 6
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Slim cones, closed at their feet: vertices and unit normals [K, sides + 2, 3], int32 faces
    [K, 2 sides, 3].

    Args:
        root, axis: [K, 3] middle of the foot, and unit direction to the tip.
    """
    count = len(root)
    side = np.cross(axis, np.where(np.abs(axis[:, 2:]) < 0.9, [[0.0, 0, 1]], [[1.0, 0, 0]]))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    angle = 2 * np.pi * np.arange(sides)[:, None] / sides
    around = np.cos(angle) * side[:, None] + np.sin(angle) * np.cross(axis, side)[:, None]
    foot = root[:, None] + radius * around
    vertices = np.concatenate([foot, (root + length * axis)[:, None], root[:, None]], 1)
    normals = np.concatenate([around, axis[:, None], -axis[:, None]], 1)
    a = np.arange(sides)
    b, tip, middle = (a + 1) % sides, np.full(sides, sides), np.full(sides, sides + 1)
    one = np.concatenate([np.stack([a, b, tip], -1), np.stack([b, a, middle], -1)])
    return vertices, normals, (one + (sides + 2) * np.arange(count)[:, None, None]).astype(np.int32)


def _triple(values: np.ndarray) -> Triple:
    x, y, z = values.tolist()
    return x, y, z


def _swirl(p: np.ndarray) -> np.ndarray:
    phase = 7 * p[..., 2] + 2 * np.arctan2(p[..., 1], p[..., 0])
    return 0.42 + 0.3 * np.sin(phase[..., None] + np.array([0.0, 2.1, 4.2]))


def _striped(p: np.ndarray) -> np.ndarray:
    light = np.sin(12 * np.arctan2(p[..., 1], p[..., 0])) > 0
    return np.where(light[..., None], [0.75, 0.72, 0.65], [0.6, 0.12, 0.1])


def _checked(p: np.ndarray) -> np.ndarray:
    even = np.floor(p / 0.2 + 0.5).astype(int).sum(-1) % 2 == 0
    return np.where(even[..., None], [0.6, 0.5, 0.35], [0.2, 0.28, 0.45])


def _banded(p: np.ndarray) -> np.ndarray:
    return np.where(p[..., 2:] % 0.3 > 0.15, [0.7, 0.6, 0.2], [0.25, 0.3, 0.3])


def _walls(p: np.ndarray) -> np.ndarray:
    """Red and green where +X and -X walls face in, grey checks elsewhere."""
    inside = (np.abs(p[..., :2]) < 0.46).all(-1)
    even = np.floor(p / 0.25).astype(int).sum(-1) % 2 == 0
    base = np.where(even[..., None], [0.7, 0.7, 0.7], [0.45, 0.45, 0.45])
    base = np.where((inside & (p[..., 0] > 0.44))[..., None], [0.65, 0.08, 0.06], base)
    return np.where((inside & (p[..., 0] < -0.44))[..., None], [0.1, 0.5, 0.1], base)
