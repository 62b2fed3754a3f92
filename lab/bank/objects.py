"""Random objects: pots, bottles, animals, cars, chairs, lamps and others, of several parts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.interpolate import PchipInterpolator

from lab.bank.materials import Material, noise
from lab.stress.shapes import Distance, Part, ball, ring, rod, rounded_box, surface

Random: TypeAlias = np.random.Generator

RADIUS = 0.86  # of the ball about the origin that objects are brought into, world units
CELLS = 110  # of the grid that a part is marched on, along its longest side


@dataclass(frozen=True)
class Piece:
    """A closed piece in coordinates of its own; of any size, as all of an object is scaled."""

    distance: Distance
    half: tuple[float, float, float]  # of the box about its origin that holds it
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn: np.ndarray | None = None  # [3, 3] to the object's coordinates
    role: str = "body"  # pieces of one role are of one material
    cells: int = CELLS


def object_of(
    family: str, random: Random, materials: Callable[[str], Material], detail: float = 1.0
) -> list[Part]:
    """The parts of an object, within a ball of RADIUS about the origin, +Z up.

    Args:
        family: of FAMILIES.
        materials: the material of each role; asked once for each.
        detail: times as many triangles along a side, for larger pictures.
    """
    pieces = FAMILIES[family](random)
    found = [(piece, *_placed(piece, detail)) for piece in pieces]
    everywhere = np.concatenate([vertices for _, vertices, _, _ in found])
    low, high = everywhere.min(0), everywhere.max(0)
    middle = (low + high) / 2
    scale = RADIUS / np.linalg.norm(everywhere - middle, axis=1).max()
    known: dict[str, Material] = {}
    parts = []
    for piece, vertices, faces, normals in found:
        if piece.role not in known:
            known[piece.role] = materials(piece.role)
        place = scale * (vertices - middle)
        values = known[piece.role](place, normals)
        arrays = [np.ascontiguousarray(x, dtype=np.float32) for x in (place, normals, *values)]
        parts.append(Part(arrays[0], faces.astype(np.int32), arrays[1], *arrays[2:]))
    return parts


def roles(family: str, random: Random) -> list[str]:
    """The roles of an object's pieces, each once."""
    return list(dict.fromkeys(piece.role for piece in FAMILIES[family](random)))


def _placed(piece: Piece, detail: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices [P, 3], faces [F, 3] and unit normals [P, 3] in the object's coordinates."""
    longest = 2 * max(piece.half)
    thin = 2 * min(piece.half)
    spacing = max(min(longest / piece.cells, thin / 7), longest / 200) / detail
    vertices, faces, normals = surface(piece.distance, piece.half, (spacing, spacing, spacing))
    if piece.turn is not None:
        vertices, normals = vertices @ piece.turn.T, normals @ piece.turn.T
    return vertices + np.array(piece.centre), faces, normals


# Distances, and what is made of them.


def blend(first: Distance, second: Distance, width: float) -> Distance:
    """Both, with a fillet of this width."""

    def distance(p: np.ndarray) -> np.ndarray:
        a, b = first(p), second(p)
        h = np.maximum(width - np.abs(a - b), 0) / width
        return np.minimum(a, b) - h * h * width / 4

    return distance


def blended(distances: list[Distance], width: float) -> Distance:
    whole = distances[0]
    for one in distances[1:]:
        whole = blend(whole, one, width)
    return whole


def without(first: Distance, second: Distance, width: float = 0.02) -> Distance:
    """The first without the second, its new edges rounded."""
    joined = blend(lambda p: -first(p), second, width)
    return lambda p: -joined(p)


def at(distance: Distance, centre: tuple[float, float, float]) -> Distance:
    return lambda p: distance(p - np.array(centre))


def turned(distance: Distance, turn: np.ndarray) -> Distance:
    return lambda p: distance(p @ turn)


def ellipsoid(half: tuple[float, float, float]) -> Distance:
    axes = np.array(half)

    def distance(p: np.ndarray) -> np.ndarray:
        a, b = np.linalg.norm(p / axes, axis=-1), np.linalg.norm(p / axes**2, axis=-1)
        return np.where(b > 1e-9, a * (a - 1) / np.maximum(b, 1e-9), -min(half))

    return distance


def cylinder(radius: float, half: float, rounding: float) -> Distance:
    """About z."""

    def distance(p: np.ndarray) -> np.ndarray:
        q = np.stack([np.linalg.norm(p[..., :2], axis=-1) - radius, np.abs(p[..., 2]) - half], -1)
        q = q + rounding
        outside = np.linalg.norm(np.maximum(q, 0), axis=-1)
        return outside + np.minimum(q.max(-1), 0) - rounding

    return distance


def capsule(start, end, first: float, second: float) -> Distance:
    """A rod between two points whose radius changes."""
    a, b = np.array(start, float), np.array(end, float)

    def distance(p: np.ndarray) -> np.ndarray:
        t = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        return np.linalg.norm(p - a - t[..., None] * (b - a), axis=-1) - (
            first + (second - first) * t
        )

    return distance


def lathe(heights, radii, wall: float = 0.0) -> Distance:
    """Turned on a lathe: radii at heights, the lowest and highest being its ends.

    Args:
        wall: thickness where it is hollow and open above; 0: it is solid.
    """
    profile = PchipInterpolator(heights, radii)
    slope = profile.derivative()
    low, high = heights[0], heights[-1]

    def distance(p: np.ndarray) -> np.ndarray:
        z = np.clip(p[..., 2], low, high)
        radius, across = profile(z), np.linalg.norm(p[..., :2], axis=-1)
        steep = np.sqrt(1 + np.minimum(np.abs(slope(z)), 3) ** 2)
        side = (across - radius) / steep
        ends = np.maximum(low - p[..., 2], p[..., 2] - high)
        solid = _largest(side, ends, 0.03)
        if not wall:
            return solid
        inside = _largest((across - radius) / steep + wall, low + wall - p[..., 2], 0.03)
        return _largest(solid, -inside, 0.02)

    return distance


def extruded(outline: np.ndarray, half: float, rounding: float) -> Distance:
    """A polygon [K, 2] drawn out along y, from -half to half; its plane is that of x and z."""
    a = outline
    b = np.roll(outline, -1, 0)

    def distance(p: np.ndarray) -> np.ndarray:
        q = p[..., [0, 2]]
        squared = np.full(q.shape[:-1], np.inf)
        inside = np.zeros(q.shape[:-1], bool)
        for start, end in zip(a, b, strict=True):
            edge, away = end - start, q - start
            t = np.clip(away @ edge / (edge @ edge), 0, 1)
            squared = np.minimum(squared, ((away - t[..., None] * edge) ** 2).sum(-1))
            above = (start[1] > q[..., 1]) != (end[1] > q[..., 1])
            height = edge[1] if edge[1] else 1e-12
            inside ^= above & (q[..., 0] < edge[0] * (q[..., 1] - start[1]) / height + start[0])
        flat = np.where(inside, -1, 1) * np.sqrt(squared)
        d = np.stack([flat, np.abs(p[..., 1]) - half], -1) + rounding
        return np.linalg.norm(np.maximum(d, 0), axis=-1) + np.minimum(d.max(-1), 0) - rounding

    return distance


def displaced(distance: Distance, height: Callable[[np.ndarray], np.ndarray]) -> Distance:
    """A surface with its relief, which is to be flat against its size."""
    return lambda p: distance(p) - height(p)


def _largest(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    h = np.maximum(width - np.abs(a - b), 0) / width
    return np.maximum(a, b) + h * h * width / 4


def _along(direction: np.ndarray) -> np.ndarray:
    """A turn [3, 3] that brings +Z to a direction."""
    axis = direction / np.linalg.norm(direction)
    side = np.cross(axis, [1.0, 0, 0] if abs(axis[0]) < 0.9 else [0, 1.0, 0])
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(axis, side), axis], 1)


def _bar(start, end, radius: float, role: str) -> Piece:
    """A thin rod between two points, marched along its own axis."""
    a, b = np.array(start, float), np.array(end, float)
    half = float(np.linalg.norm(b - a)) / 2
    x, y, z = ((a + b) / 2).tolist()
    size = (radius, radius, half + radius)
    return Piece(rod(radius, half), size, (x, y, z), _along(b - a), role, 220)


# Families of objects. Their sizes are of the order of 1; z is up.


def pot(r: Random) -> list[Piece]:
    """A vase or jar: hollow, with a rim, and perhaps handles or a lid."""
    height = r.uniform(0.5, 0.9)
    knots = np.linspace(-height, height, 6)
    radii = r.uniform(0.25, 0.65, 6)
    radii[-1] = max(radii[-1], 0.3)
    closed = r.uniform() < 0.4
    wall = 0.0 if closed else r.uniform(0.06, 0.1)
    most = float(radii.max())
    body = lathe(knots, radii, wall)
    if r.uniform() < 0.5:  # ribs, upright or turning
        count, turn, depth = int(r.integers(6, 16)), r.uniform(-3, 3), r.uniform(0.008, 0.02)
        body = displaced(
            body,
            lambda p: depth * np.sin(count * np.arctan2(p[..., 1], p[..., 0]) + turn * p[..., 2]),
        )
    box = (most + 0.08, most + 0.08, height + 0.05)
    pieces = [Piece(body, box)]
    rim = float(radii[-1])
    if r.uniform() < 0.6:
        pieces.append(
            Piece(ring(rim, 0.06), (rim + 0.06, rim + 0.06, 0.06), (0, 0, height), None, "rim")
        )
    if r.uniform() < 0.5:
        for side in (-1, 1):
            pieces.append(_handle(side * (most * 0.95), r.uniform(-0.2, 0.3) * height, 0.25, "rim"))
    if closed:
        lid = lathe([0, 0.1, 0.2, 0.28, 0.4], [rim, 0.8 * rim, 0.1, 0.08, 0.12])
        pieces.append(
            Piece(
                at(lid, (0, 0, -0.2)),
                (rim + 0.05, rim + 0.05, 0.25),
                (0, 0, height + 0.2),
                None,
                "lid",
            )
        )
    return pieces


def _handle(x: float, z: float, size: float, role: str) -> Piece:
    """An ear of a pot: a ring in the plane of x and z."""
    upright = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    return Piece(ring(size, 0.05), (size + 0.05, size + 0.05, 0.05), (x, 0, z), upright, role)


def bottle(r: Random) -> list[Piece]:
    """A bottle with a label and a cap."""
    wide, neck = r.uniform(0.28, 0.42), r.uniform(0.1, 0.16)
    shoulder = r.uniform(0.1, 0.4)
    knots = [-0.8, -0.75, shoulder, shoulder + 0.25, 0.65, 0.8]
    body = lathe(knots, [wide - 0.05, wide, wide, neck + 0.03, neck, neck])
    count = int(r.integers(12, 30))
    cap = displaced(
        cylinder(neck + 0.05, 0.12, 0.02),
        lambda p: 0.006 * np.sin(count * np.arctan2(p[..., 1], p[..., 0])),
    )
    size = neck + 0.08
    label = cylinder(wide + 0.008, r.uniform(0.15, 0.3), 0.004)
    return [
        Piece(body, (wide + 0.05, wide + 0.05, 0.85)),
        Piece(cap, (size, size, 0.15), (0, 0, 0.85), None, "cap"),
        Piece(label, (wide + 0.02, wide + 0.02, 0.32), (0, 0, (shoulder - 0.8) / 2), None, "label"),
    ]


def mug(r: Random) -> list[Piece]:
    """A mug with a handle; a spout and a lid make it a teapot."""
    wide, height = r.uniform(0.4, 0.55), r.uniform(0.4, 0.6)
    belly = r.uniform(0.9, 1.25) * wide
    tea = r.uniform() < 0.5
    top = 0.6 * wide if tea else wide
    body = lathe([-height, 0, height], [0.85 * wide, belly, top], 0.0 if tea else 0.07)
    pieces = [Piece(body, (belly + 0.05, belly + 0.05, height + 0.05))]
    pieces.append(_handle(belly, 0.05, 0.55 * height, "handle"))
    if tea:
        spout = capsule((-0.8 * belly, 0, -0.1), (-belly - 0.35, 0, 0.9 * height), 0.13, 0.06)
        box = (belly + 0.5, 0.16, height + 0.1)
        pieces.append(Piece(spout, box, role="body"))
        lid = lathe([0, 0.12, 0.2, 0.3], [top + 0.03, 0.5 * top, 0.05, 0.09])
        pieces.append(
            Piece(
                at(lid, (0, 0, -0.15)),
                (top + 0.06, top + 0.06, 0.2),
                (0, 0, height + 0.13),
                None,
                "lid",
            )
        )
    return pieces


def animal(r: Random) -> list[Piece]:
    """A toy animal on four legs, blended into one; eyes, and perhaps a collar."""
    length, fat = r.uniform(0.35, 0.55), r.uniform(0.22, 0.32)
    leg, thick = r.uniform(0.3, 0.55), r.uniform(0.07, 0.11)
    shapes = [ellipsoid((length, fat, fat))]
    for x in (-1, 1):
        for y in (-1, 1):
            top = (0.7 * x * length, 0.55 * y * fat, -0.05)
            foot = (0.75 * x * length, 0.65 * y * fat, -fat - leg)
            shapes.append(capsule(top, foot, thick * 1.2, thick))
    head = np.array([length + r.uniform(0.05, 0.2), 0, fat + r.uniform(0.05, 0.4)])
    shapes.append(capsule((0.7 * length, 0, 0.05), head, 0.16, 0.12))
    size = r.uniform(0.17, 0.24)
    shapes.append(at(ball(size), (head[0], 0, head[2])))
    shapes.append(capsule(head, head + np.array([size + 0.12, 0, -0.06]), 0.13, 0.08))
    ear = r.uniform(0.15, 0.45)
    for y in (-1, 1):
        start = head + np.array([-0.03, 0.6 * y * size, 0.6 * size])
        shapes.append(capsule(start, start + np.array([-0.05, 0.1 * y, ear]), 0.07, 0.045))
    shapes.append(
        capsule((-length, 0, 0.05), (-length - 0.25, 0, r.uniform(-0.2, 0.3)), 0.06, 0.03)
    )
    body = blended(shapes, 0.09)
    tall = float(head[2]) + size + ear + 0.1
    box = (length + 0.75, max(fat, 0.35) + 0.1, max(tall, fat + leg + 0.2))
    pieces = [Piece(body, box, cells=150)]
    for y in (-1, 1):
        place = head + size * np.array([0.8, 0.5 * y, 0.35])
        pieces.append(Piece(ball(0.05), (0.05, 0.05, 0.05), tuple(place), None, "eyes", 24))
    if r.uniform() < 0.6:
        turn = _along(head - np.array([0.7 * length, 0, 0.05]))
        neck = 0.5 * head + 0.5 * np.array([0.7 * length, 0, 0.05])
        pieces.append(Piece(ring(0.17, 0.04), (0.21, 0.21, 0.04), tuple(neck), turn, "collar"))
    return pieces


def car(r: Random) -> list[Piece]:
    """A toy car."""
    length, wide, low = r.uniform(0.6, 0.8), r.uniform(0.28, 0.36), r.uniform(0.13, 0.2)
    wheel = r.uniform(0.15, 0.2)
    cabin = r.uniform(0.3, 0.5) * length
    hull = blend(
        rounded_box((length, wide, low), 0.08),
        at(rounded_box((cabin, 0.85 * wide, 0.17), 0.09), (r.uniform(-0.2, 0.1), 0, low + 0.1)),
        0.1,
    )
    places = [(0.62 * x * length, y * wide, -low) for x in (-1, 1) for y in (-1, 1)]
    aside = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    for place in places:
        hull = without(hull, at(turned(cylinder(wheel + 0.03, 0.14, 0.02), aside), place))
    pieces = [Piece(hull, (length + 0.05, wide + 0.05, low + 0.35), cells=140)]
    for place in places:
        pieces.append(
            Piece(cylinder(wheel, 0.07, 0.03), (wheel, wheel, 0.07), place, aside, "tyres", 60)
        )
        hub = 0.55 * wheel
        pieces.append(
            Piece(cylinder(hub, 0.085, 0.02), (hub, hub, 0.085), place, aside, "hubs", 50)
        )
    return pieces


def chair(r: Random) -> list[Piece]:
    """A chair or stool of thin legs."""
    wide, thick = r.uniform(0.35, 0.5), r.uniform(0.04, 0.08)
    spread, radius = r.uniform(1.0, 1.3), r.uniform(0.025, 0.045)
    corners = [(x * 0.85 * wide, y * 0.85 * wide) for x in (-1, 1) for y in (-1, 1)]
    seat = rounded_box((wide, wide, thick), 0.9 * thick)
    pieces = [Piece(seat, (wide, wide, thick), role="seat")]
    for x, y in corners:
        pieces.append(_bar((x, y, 0), (spread * x, spread * y, -0.8), radius, "body"))
    if r.uniform() < 0.7:
        height = r.uniform(0.6, 0.9)
        back = [(-0.9 * wide, y * 0.85 * wide) for y in np.linspace(-1, 1, int(r.integers(3, 6)))]
        for x, y in back:
            pieces.append(_bar((x, y, 0), (1.2 * x, y, height), radius, "body"))
        pieces.append(
            Piece(
                rounded_box((0.05, wide, 0.09), 0.04),
                (0.05, wide, 0.09),
                (1.08 * -wide, 0, height),
                role="seat",
            )
        )
    return pieces


def lamp(r: Random) -> list[Piece]:
    """A table lamp: foot, stem, shade."""
    foot, shade = r.uniform(0.3, 0.45), r.uniform(0.4, 0.6)
    top, tall = r.uniform(0.15, 0.4), r.uniform(0.25, 0.4)
    belly = r.uniform(0.05, 0.2)
    stem = lathe([-0.7, -0.4, -0.1, 0.4], [0.06, belly, 0.05, 0.05])
    cone = lathe([-tall, tall], [shade, top], 0.05)
    hollow = without(cone, at(cylinder(shade - 0.06, 0.06, 0.01), (0, 0, -tall)))
    return [
        Piece(cylinder(foot, 0.05, 0.04), (foot, foot, 0.05), (0, 0, -0.72), None, "body"),
        Piece(
            at(stem, (0, 0, 0.15)), (belly + 0.06, belly + 0.06, 0.6), (0, 0, -0.15), None, "stem"
        ),
        Piece(hollow, (shade + 0.03, shade + 0.03, tall + 0.05), (0, 0, 0.45), None, "shade"),
    ]


def emblem(r: Random) -> list[Piece]:
    """A star, gear or letter on a plinth."""
    kind = r.choice(["star", "gear", "letter"])
    if kind == "letter":
        cuts = {
            "L": [(-0.4, -0.6), (0.4, -0.6), (0.4, -0.3), (-0.1, -0.3), (-0.1, 0.6), (-0.4, 0.6)],
            "T": [
                (-0.15, -0.6),
                (0.15, -0.6),
                (0.15, 0.3),
                (0.5, 0.3),
                (0.5, 0.6),
                (-0.5, 0.6),
                (-0.5, 0.3),
                (-0.15, 0.3),
            ],
            "E": [
                (-0.4, -0.6),
                (0.4, -0.6),
                (0.4, -0.36),
                (-0.1, -0.36),
                (-0.1, -0.12),
                (0.3, -0.12),
                (0.3, 0.12),
                (-0.1, 0.12),
                (-0.1, 0.36),
                (0.4, 0.36),
                (0.4, 0.6),
                (-0.4, 0.6),
            ],
        }
        outline = np.array(cuts[str(r.choice(list(cuts)))], float)
    else:
        points = int(r.integers(5, 9)) if kind == "star" else int(r.integers(8, 13))
        inner = r.uniform(0.3, 0.42) if kind == "star" else 0.48
        count = 2 * points if kind == "star" else 4 * points
        angle = 2 * np.pi * (np.arange(count) + 0.5) / count - np.pi / 2
        outer = np.arange(count) % 2 == 0 if kind == "star" else np.arange(count) % 4 < 2
        radius = np.where(outer, 0.62, inner)
        outline = np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1)
    thick = r.uniform(0.1, 0.2)
    body = extruded(outline, thick, 0.025)
    if kind == "gear":
        aside = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
        body = without(body, turned(cylinder(r.uniform(0.1, 0.25), 1, 0.01), aside))
    plinth = (r.uniform(0.4, 0.6), r.uniform(0.25, 0.4), 0.12)
    return [
        Piece(body, (0.7, thick + 0.03, 0.7), cells=140),
        Piece(rounded_box(plinth, 0.03), plinth, (0, 0, -0.66), None, "plinth"),
    ]


def relief(r: Random) -> list[Piece]:
    """A box, plate or ball with an embossed pattern."""
    depth, count = r.uniform(0.012, 0.03), r.uniform(6, 12)
    kind = r.choice(["box", "ball", "plate"])
    shape = {
        "box": rounded_box((0.5, 0.4, 0.35), 0.06),
        "ball": ellipsoid((0.5, 0.5, r.uniform(0.4, 0.6))),
        "plate": cylinder(0.6, 0.12, 0.05),
    }[str(kind)]
    swirls = noise(r, 1.5, 2)
    if r.uniform() < 0.5:
        body = displaced(shape, lambda p: depth * np.tanh(3 * np.sin(count * p).prod(-1)))
    else:
        body = displaced(shape, lambda p: depth * np.tanh(1.5 * swirls(p)))
    pieces = [Piece(body, (0.66, 0.66, 0.66), cells=150)]
    if kind != "plate":
        knob = r.uniform(0.08, 0.14)
        top = 0.38 if kind == "box" else 0.55
        pieces.append(Piece(ball(knob), (knob, knob, knob), (0, 0, top), None, "knob", 50))
        for x, y in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
            foot = (0.3 * x, 0.25 * y, -0.38)
            pieces.append(Piece(ball(0.1), (0.1, 0.1, 0.1), foot, None, "knob", 40))
    return pieces


def plant(r: Random) -> list[Piece]:
    """A pot with leaves."""
    wide = r.uniform(0.25, 0.35)
    body = lathe([-0.3, 0.25, 0.3], [0.7 * wide, wide, wide + 0.03], 0.05)
    soil = cylinder(wide - 0.03, 0.03, 0.01)
    size = wide + 0.08
    pieces = [
        Piece(body, (size, size, 0.35), (0, 0, -0.5)),
        Piece(soil, (wide, wide, 0.03), (0, 0, -0.3), None, "soil"),
    ]
    for k in range(int(r.integers(6, 11))):
        angle = 2.4 * k + r.uniform(-0.3, 0.3)
        up = r.uniform(0.5, 1.3)
        way = np.array([np.cos(angle), np.sin(angle), up])
        way /= np.linalg.norm(way)
        length = r.uniform(0.25, 0.4)
        half = (length / 3, 0.02, length)
        turn = _along(way)
        side = np.cross([0, 0, 1.0], way)
        side /= np.linalg.norm(side)
        turn = np.stack([side, np.cross(way, side), way], 1)
        x, y, z = (np.array([0, 0, -0.3]) + way * (length + 0.12)).tolist()
        pieces.append(Piece(ellipsoid(half), half, (x, y, z), turn, "leaves", 120))
        pieces.append(_bar((0, 0, -0.32), (x, y, z), 0.018, "leaves"))
    return pieces


def trophy(r: Random) -> list[Piece]:
    """Primitives on top of one another."""
    z, pieces = 0.0, []
    for k in range(int(r.integers(3, 6))):
        size = r.uniform(0.2, 0.45) * (1 - 0.1 * k)
        tall = r.uniform(0.12, 0.3)
        kind = r.choice(["box", "ball", "cylinder", "ring", "cone"])
        match kind:
            case "box":
                shape, half = rounded_box((size, size, tall), 0.04), (size, size, tall)
            case "ball":
                tall = size
                shape, half = ball(size), (size, size, size)
            case "cylinder":
                shape, half = cylinder(size, tall, 0.04), (size, size, tall)
            case "ring":
                tall = 0.3 * size
                shape, half = ring(size, tall), (size + tall, size + tall, tall)
            case _:
                shape = lathe([-tall, tall], [size, 0.3 * size])
                half = (size + 0.02, size + 0.02, tall + 0.02)
        pieces.append(Piece(shape, half, (0, 0, z + tall), None, f"tier{k % 3}"))
        z += 1.9 * tall
    return pieces


def tool(r: Random) -> list[Piece]:
    """A hammer that stands on its head, or lies."""
    grip, head = r.uniform(0.05, 0.08), r.uniform(0.12, 0.18)
    handle = capsule((0, 0, -0.6), (0, 0, 0.75), grip * 1.2, grip * 0.9)
    aside = np.array([[0, 0, 1.0], [0, 1.0, 0], [-1.0, 0, 0]])
    top = blend(
        turned(cylinder(head, 0.35, 0.03), aside),
        capsule((-0.3, 0, 0), (-0.6, 0, -0.12), 0.8 * head, 0.3 * head),
        0.08,
    )
    band = cylinder(1.3 * grip, 0.2, 0.02)
    return [
        Piece(handle, (0.12, 0.12, 0.9), role="handle"),
        Piece(top, (0.75, head + 0.05, head + 0.12), (0, 0, -0.65), None, "body"),
        Piece(band, (0.12, 0.12, 0.2), (0, 0, 0.5), None, "grip"),
    ]


def pebble(r: Random) -> list[Piece]:
    """A stone, root or bronze blob: one part, uneven all over."""
    rough = noise(r, r.uniform(0.8, 1.4), 3)
    half = tuple(r.uniform(0.35, 0.6, 3).tolist())
    amount = r.uniform(0.02, 0.05)
    body = displaced(ellipsoid(half), lambda p: amount * rough(p))
    size = max(half) + 4 * amount
    return [Piece(body, (size, size, size), cells=130)]


FAMILIES: dict[str, Callable[[Random], list[Piece]]] = {
    f.__name__: f
    for f in (
        pot,
        bottle,
        mug,
        animal,
        car,
        chair,
        lamp,
        emblem,
        relief,
        plant,
        trophy,
        tool,
        pebble,
    )
}
