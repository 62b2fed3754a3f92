"""Random materials: what they are at points of a surface."""

from __future__ import annotations

import colorsys
from collections.abc import Callable
from typing import Literal, TypeAlias

import numpy as np

# Points and unit normals [P, 3] to base colour [P, 3], roughness [P] and metallic [P]
Material: TypeAlias = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]
Share: TypeAlias = Callable[[np.ndarray, np.ndarray], np.ndarray]  # to [P] in [0, 1]
Class: TypeAlias = Literal["none", "some", "all"]

METALS = {
    "gold": (1.0, 0.75, 0.35),
    "copper": (0.93, 0.6, 0.47),
    "brass": (0.88, 0.72, 0.42),
    "steel": (0.57, 0.56, 0.54),
    "aluminium": (0.88, 0.89, 0.9),
    "iron": (0.45, 0.42, 0.4),
    "bronze": (0.7, 0.5, 0.3),
}
OXIDES = ((0.22, 0.42, 0.36), (0.3, 0.14, 0.06), (0.06, 0.06, 0.06))  # verdigris, rust, black
WAVES = 14  # of a noise
EDGE = 0.12  # of noise, over which one material becomes the other


def noise(random: np.random.Generator, scale: float, octaves: int = 1) -> Callable:
    """A smooth function of points, of mean 0 and deviation 1; `scale` in waves a world unit."""
    way = random.standard_normal((octaves, WAVES, 3))
    way *= scale * 2.0 ** np.arange(octaves)[:, None, None]
    phase = random.uniform(0, 2 * np.pi, (octaves, WAVES))
    weight = 0.5 ** np.arange(octaves)
    weight *= np.sqrt(2 / WAVES) / np.linalg.norm(weight)

    def value(p: np.ndarray) -> np.ndarray:
        total = np.zeros(p.shape[:-1])
        for w, a, b in zip(weight, way, phase, strict=True):
            for direction, start in zip(a, b, strict=True):
                total += w * np.sin(2 * np.pi * (p @ direction) + start)
        return total

    return value


def dielectric(random: np.random.Generator) -> Material:
    """Paint, plastic, lacquer, wood, stone or cloth: none of it metal."""
    kind = random.choice(["paint", "plastic", "lacquer", "wood", "stone", "weave", "two"])
    match kind:
        case "paint":
            return _plain(random, random.uniform(0.4, 0.9), 0.0)
        case "plastic":
            return _plain(random, random.uniform(0.15, 0.45), 0.0)
        case "lacquer":  # a smooth coat over colour: one lobe, and what is below it is diffuse
            return _plain(random, random.uniform(0.04, 0.14), 0.0)
        case "wood":
            return wood(random)
        case "stone":
            veins = noise(random, 1.5, 3)
            pair = _plain(random, random.uniform(0.2, 0.7), 0.0), _plain(random, 0.5, 0.0)
            return mixed(*pair, lambda p, n: np.exp(-((veins(p) / 0.35) ** 2)))
        case "weave":
            count, two = random.uniform(14, 28), _color(random)
            first = _plain(random, 0.85, 0.0)
            return mixed(first, uniform(two, 0.8, 0.0), _checks(count))
        case _:  # two paints in a pattern
            rough = random.uniform(0.15, 0.8, 2)
            first, second = (_plain(random, float(r), 0.0) for r in rough)
            return mixed(first, second, pattern(random))


def metal(random: np.random.Generator) -> Material:
    """Polished, brushed or rough metal, all of it metal."""
    base = np.array(METALS[str(random.choice(list(METALS)))])
    low, high = ((0.05, 0.15), (0.15, 0.35), (0.35, 0.6))[random.integers(3)]
    rough = random.uniform(low, high)
    smears = noise(random, random.uniform(1, 4), 2)
    amount = random.uniform(0, 0.25)

    def material(p: np.ndarray, _: np.ndarray):
        roughness = np.clip(rough * (1 + amount * smears(p)), 0.03, 1)
        return np.broadcast_to(base, p.shape), roughness, np.ones(len(p))

    return material


def partly_metal(random: np.random.Generator) -> Material:
    """Patina, worn paint over metal, or a pattern of metal and paint."""
    kind = random.choice(["patina", "worn", "inlay"])
    if kind == "patina":
        oxide = np.array(OXIDES[random.integers(len(OXIDES))])
        other = uniform(oxide * random.uniform(0.8, 1.2, 3), random.uniform(0.6, 0.9), 0.0)
        return mixed(metal(random), other, _blotches(random))
    other = _plain(random, random.uniform(0.2, 0.7), 0.0)
    share = _blotches(random) if kind == "worn" else pattern(random)
    return mixed(other, metal(random), share)


def mixed(first: Material, second: Material, share: Share) -> Material:
    """The first material where `share` is 0, the second where it is 1."""

    def material(p: np.ndarray, n: np.ndarray):
        s = np.clip(share(p, n), 0, 1)
        pairs = zip(first(p, n), second(p, n), strict=True)
        base, roughness, metallic = (
            a + (b - a) * (s[:, None] if a.ndim == 2 else s) for a, b in pairs
        )
        return base, roughness, metallic

    return material


def pattern(random: np.random.Generator) -> Share:
    """Stripes, rings, checks, dots or blotches; some of them fine."""
    fine = random.uniform() < 0.3
    count = random.uniform(10, 20) if fine else random.uniform(2, 6)
    phase = random.uniform(0, 2 * np.pi)
    turn = int(max(3, round(2 * count)))

    def waves(value: np.ndarray) -> np.ndarray:
        return 0.5 + 4 * np.sin(value + phase)

    match random.choice(["stripes", "rings", "checks", "dots", "blotches"]):
        case "stripes":
            return lambda p, _: waves(turn * np.arctan2(p[:, 1], p[:, 0]))
        case "rings":
            return lambda p, _: waves(2 * np.pi * count * p[:, 2])
        case "checks":
            return _checks(count)
        case "dots":
            return lambda p, _: 8 * (np.sin(2 * np.pi * count * p).prod(1) - 0.2)
        case _:
            return _blotches(random)


def _checks(count: float) -> Share:
    return lambda p, _: 0.5 + 6 * np.sin(np.pi * count * p + 0.4).prod(1)


def _blotches(random: np.random.Generator) -> Share:
    """Smooth islands, more of them where the surface faces down or up."""
    field, level = noise(random, random.uniform(0.8, 2.5), 3), random.uniform(-0.6, 0.4)
    lean = random.uniform(-0.6, 0.6)
    return lambda p, n: 0.5 + (field(p) + lean * n[:, 2] - level) / EDGE / 2


def _plain(random: np.random.Generator, roughness: float, metallic: float) -> Material:
    """One colour, a little uneven."""
    base, uneven = _color(random), noise(random, random.uniform(1, 6), 2)
    amount = random.uniform(0, 0.1)

    def material(p: np.ndarray, _: np.ndarray):
        shown = np.clip(base * (1 + amount * uneven(p))[:, None], 0.01, 0.95)
        return shown, np.full(len(p), roughness), np.full(len(p), metallic)

    return material


def uniform(base: np.ndarray, roughness: float, metallic: float) -> Material:
    shown = np.clip(base, 0.01, 0.95)
    return lambda p, _: (
        np.broadcast_to(shown, p.shape),
        np.full(len(p), roughness),
        np.full(len(p), metallic),
    )


def wood(random: np.random.Generator) -> Material:
    light = random.uniform(0.25, 0.65) * np.array([1.0, random.uniform(0.6, 0.8), 0.35])
    bent, count = noise(random, 0.7, 2), random.uniform(4, 9)
    rough = random.uniform(0.15, 0.7)
    first, second = uniform(light, rough, 0.0), uniform(0.55 * light, rough, 0.0)

    def grain(p: np.ndarray, _: np.ndarray) -> np.ndarray:
        rings = np.hypot(p[:, 0] + 0.3, p[:, 1]) + 0.06 * bent(p * [1, 1, 0.3])
        return 0.5 + 0.5 * np.sin(2 * np.pi * count * 2 * rings)

    return mixed(first, second, grain)


def _color(random: np.random.Generator) -> np.ndarray:
    """A linear colour of paint: some grey or white, some dark, most of any hue."""
    kind = random.uniform()
    if kind < 0.2:
        return np.full(3, random.uniform(0.55, 0.85)) * random.uniform(0.9, 1.0, 3)
    if kind < 0.3:
        return np.full(3, random.uniform(0.03, 0.1))
    saturation, value = random.uniform(0.3, 0.85), random.uniform(0.25, 0.8)
    return np.array(colorsys.hsv_to_rgb(random.uniform(), saturation, value))
