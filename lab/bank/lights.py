"""Random light: rooms with windows and lamps, sky and sun, studios."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from lab.stress import scenes
from univoxel.sphere import latlong_directions, texel_solid_angles

Radiance: TypeAlias = Callable[[np.ndarray], np.ndarray]  # unit [..., 3] to linear [..., 3]
Kind: TypeAlias = str

KINDS = ("room", "lamps", "sky", "overcast", "studio", "suite")
# Of photographs and of relit views; lamps and windows are common, and so is daylight
SHARES = (0.35, 0.15, 0.2, 0.1, 0.1, 0.1)
MAP_HEIGHT = 256  # of the maps
ROWS = 96  # of the map by which brightness is measured
MIDDLE = 1.0  # irradiance over pi, mean over all normals, that every light is brought to


def light(kind: Kind, random: np.random.Generator) -> Radiance:
    """A light of a kind, as bright as all others in the mean over all directions.

    Raises:
        ValueError: there is no such kind.
    """
    match kind:
        case "room":
            found = _room(random, int(random.integers(1, 4)), int(random.integers(0, 3)))
        case "lamps":
            found = _room(random, 0, int(random.integers(2, 5)))
        case "sky":
            found = _sky(random, random.uniform(0.3, 0.85))
        case "overcast":
            found = _sky(random, 0.0)
        case "studio":
            found = _studio(random)
        case "suite":
            found = _of_suite(str(random.choice(["room", "dusk"])))
        case _:
            raise ValueError(f"light must be of {', '.join(KINDS)}, got {kind!r}")
    grid = latlong_directions(ROWS).double().numpy()
    weight = texel_solid_angles(ROWS, 2 * ROWS).double().numpy()[..., None]
    mean = float((found(grid) * weight).sum((0, 1)).mean()) / (4 * math.pi)
    return lambda direction: MIDDLE / mean * found(direction)


def tabulated(radiance: Radiance, poles: bool = False) -> np.ndarray:
    """A map [H, 2H, 3] float32; `poles` as in `lab.stress.scenes.environment`."""
    return radiance(scenes.directions_of_map(MAP_HEIGHT, poles)).astype(np.float32)


def _of_suite(name: str) -> Radiance:
    return lambda direction: scenes.radiance(name, direction)


def _room(random: np.random.Generator, windows: int, lamps: int) -> Radiance:
    """What is seen from above a table in a room of boxes: walls, furniture, windows, lamps.

    Walls are lit by windows and lamps as by points, and by what the room sends back, the same
    everywhere. Metres; the table's top is below the origin.
    """
    low = np.array([-random.uniform(1, 3), -random.uniform(1, 3), -random.uniform(0.8, 1.2)])
    high = np.array([random.uniform(1, 3), random.uniform(1, 3), random.uniform(1.4, 1.9)])
    wall = _pale(random)
    colors = np.stack([wall] * 4 + [_wood(random), np.full(3, random.uniform(0.75, 0.9))])
    if random.uniform() < 0.3:
        colors[random.integers(4)] = random.uniform(0.1, 0.7, 3)  # one painted wall
    top, top_height = _wood(random), -random.uniform(0.1, 0.3)
    top_half = random.uniform(0.4, 0.8, 2)
    tints = [np.array([0.9, 1.0, 1.15]), np.array([1.0, 1.0, 1.0]), np.array([1.15, 1.0, 0.8])]
    panes = []
    for _ in range(windows):
        face, along = int(random.integers(4)), random.uniform(-0.5, 0.5)
        half = np.array([random.uniform(0.3, 0.8), random.uniform(0.3, 0.6)])
        axis, other = face // 2, 1 - face // 2
        middle = np.zeros(3)
        middle[axis] = (low, high)[face % 2][axis]
        middle[other] = (low[other] + high[other]) / 2 + along * (high[other] - low[other]) / 2
        middle[2] = random.uniform(0.1, 0.5)
        power = random.uniform(8, 25) * tints[random.integers(3)]
        panes.append((face, middle, half, power))
    bulbs = []
    for _ in range(lamps):
        place = random.uniform(0.75 * low, 0.75 * high)
        place[2] = random.uniform(0.4, high[2] - 0.1)
        warm = np.array([1.3, 1.0, random.uniform(0.4, 0.9)])
        bulbs.append((place, random.uniform(0.06, 0.2), random.uniform(20, 60) * warm))
    furniture = []
    for _ in range(int(random.integers(1, 5))):
        side = random.uniform(0.2, 0.6, 3)
        corner = np.where(random.uniform(size=3) < 0.5, low, high - side)
        corner[2] = low[2]
        side[2] = random.uniform(0.4, 1.9)
        furniture.append((corner, corner + side, random.uniform(0.05, 0.6, 3)))
    sources = [(m, 4 * h[0] * h[1] * p) for _, m, h, p in panes]
    sources += [(m, math.pi * r * r * p) for m, r, p in bulbs]
    reflected = 0.5 * sum(p for _, p in sources) / (2 * np.prod(high - low) ** (2 / 3) * 3)

    def lit(point: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Irradiance over pi."""
        total = np.broadcast_to(reflected, point.shape).copy()
        for middle, power in sources:
            away = middle - point
            squared = (away**2).sum(-1, keepdims=True)
            cosine = (away * normal).sum(-1, keepdims=True) / np.sqrt(squared)
            total += np.maximum(cosine, 0) * power / (math.pi * np.maximum(squared, 0.15))
        return total

    def radiance(direction: np.ndarray) -> np.ndarray:
        d = np.where(np.abs(direction) < 1e-9, 1e-9, direction)
        ahead = np.where(d > 0, high, low) / d
        axis = ahead.argmin(-1)
        t = ahead.min(-1)
        point = t[..., None] * d
        normal = -np.sign(d) * np.eye(3)[axis]
        face = 2 * axis + (np.take_along_axis(d, axis[..., None], -1)[..., 0] > 0)
        base = colors[face]
        for lower, upper, color in furniture:
            near, axis = np.minimum(lower / d, upper / d).max(-1), None
            which = np.minimum(lower / d, upper / d).argmax(-1)
            met = (near < np.maximum(lower / d, upper / d).min(-1)) & (near > 0) & (near < t)
            t = np.where(met, near, t)
            point = np.where(met[..., None], near[..., None] * d, point)
            normal = np.where(met[..., None], -np.sign(d) * np.eye(3)[which], normal)
            base = np.where(met[..., None], color, base)
            face = np.where(met, -1, face)
        down = top_height / d[..., 2]
        place = down[..., None] * d
        met = (d[..., 2] < 0) & (np.abs(place[..., :2]) < top_half).all(-1)
        point = np.where(met[..., None], place, point)
        normal = np.where(met[..., None], [0.0, 0.0, 1.0], normal)
        base = np.where(met[..., None], top, base)
        face = np.where(met, -1, face)
        shown = base * lit(point, normal)
        for pane, middle, half, power in panes:
            other = 1 - pane // 2
            across = (point[..., other] - middle[other]) / half[0]
            up = (point[..., 2] - middle[2]) / half[1]
            bars = (np.abs(across) > 0.05) & (np.abs(across) < 1) & (np.abs(up) < 1)
            view = np.where(up[..., None] > -0.2, 1.0, [0.35, 0.4, 0.3])  # ground outside
            shown = np.where((bars & (face == pane))[..., None], power * view, shown)
        for middle, radius, power in bulbs:
            distance = float(np.linalg.norm(middle))
            edge = math.cos(math.asin(min(radius / distance, 0.9)))
            within = direction @ (middle / distance) > edge
            shown = np.where((within & (distance < t))[..., None], power, shown)
        return shown

    return radiance


def _sky(random: np.random.Generator, sun: float) -> Radiance:
    """A sky with ground, houses and trees on the horizon, and a sun of so much of the power."""
    zenith = np.array([0.25, 0.45, 1.0]) if sun else np.array([0.85, 0.9, 1.0])
    horizon = np.array([0.8, 0.9, 1.0]) if sun else np.array([0.7, 0.72, 0.75])
    ground = random.uniform(0.5, 1.2) * random.choice(
        np.array([[0.35, 0.33, 0.3], [0.15, 0.22, 0.08], [0.4, 0.34, 0.24], [0.22, 0.22, 0.23]])
    )
    height = random.uniform(18, 65)
    towards = scenes.unit_direction(random.uniform(-180, 180), height)
    warm = np.array([1.15, 1.0, 0.6 + 0.35 * height / 65])
    sharpness = 2000.0  # three degrees at half its height
    phase = random.uniform(0, 2 * math.pi, 6)
    tops = random.uniform(0.02, 0.1, 6)
    side = random.uniform(0.1, 0.5, 3)

    def radiance(direction: np.ndarray) -> np.ndarray:
        z = direction[..., 2:]
        azimuth = np.arctan2(direction[..., 1:2], direction[..., :1])
        color = horizon + (zenith - horizon) * np.clip(z, 0, 1) ** 0.5
        color = color * (1 + 0.3 * np.maximum(direction @ towards, 0)[..., None] ** 4)
        waves = [
            h * np.sin((k + 2) * azimuth + p)
            for k, (h, p) in enumerate(zip(tops, phase, strict=True))
        ]
        skyline = 0.06 + np.abs(sum(waves))
        color = np.where((z > 0) & (z < skyline), side * (0.6 + 0.4 * z / skyline), color)
        color = np.where(z <= 0, ground * (1 + 0.2 * np.sin(9 * azimuth)), color)
        if not sun:
            return color
        power = sun / (1 - sun) * 4 * math.pi * 0.4
        peak = power * sharpness / (2 * math.pi) * warm
        return color + peak * np.exp(sharpness * (direction @ towards - 1))[..., None]

    return radiance


def _studio(random: np.random.Generator) -> Radiance:
    """Soft boxes before a plain backdrop, and a bright table."""
    backdrop = np.full(3, random.choice([0.03, 0.15, 0.6]))
    table = random.uniform(0.3, 1.0)
    boxes = [
        (
            scenes.unit_direction(random.uniform(-180, 180), random.uniform(10, 70)),
            math.cos(math.radians(random.uniform(10, 25))),
            random.uniform(4, 12) * np.array([1.0, random.uniform(0.9, 1), random.uniform(0.8, 1)]),
        )
        for _ in range(int(random.integers(2, 4)))
    ]

    def radiance(direction: np.ndarray) -> np.ndarray:
        z = direction[..., 2:]
        color = np.where(z < -0.25, table, backdrop * (1 + 0.5 * z))
        for towards, edge, power in boxes:
            soft = np.clip((direction @ towards - edge) / 0.01, 0, 1)[..., None]
            color = color + soft * power
        return color

    return radiance


def _pale(random: np.random.Generator) -> np.ndarray:
    return random.uniform(0.45, 0.85) * np.array(
        [1, random.uniform(0.85, 1), random.uniform(0.7, 1)]
    )


def _wood(random: np.random.Generator) -> np.ndarray:
    return random.uniform(0.12, 0.6) * np.array([1, random.uniform(0.7, 1), random.uniform(0.4, 1)])
