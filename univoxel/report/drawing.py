"""Drawings of a report, as SVG in the text of a page."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from univoxel.confidence.advice import Advice, azimuths, elevations
from univoxel.pictures.contact_sheet import heat

RADIUS = 200.0  # of the drawn sphere
ROOM = 34.0  # around it, for words
RINGS = (-60, -30, 0, 30, 60)  # elevations, degrees
WIDTH, HEIGHT = 560.0, 190.0  # of a chart
LEFT, BOTTOM, TOP = 56.0, 24.0, 12.0  # of it, for numbers
TICKS = 4  # numbers along an axis, about


@dataclass(frozen=True)
class Curve:
    """A measure over time, in pieces: what lies between two of them is not joined."""

    title: str
    pieces: Sequence[Sequence[tuple[float, float]]]  # (seconds, value)
    logarithmic: bool = False


def sphere(advice: Advice) -> str:
    """The directions around an object seen from above, the front below: what a photograph from each
    is worth, gaps, photographs that were taken, and the advised ones by number.

    Areas are true: the zenith is in the middle, the nadir the rim, or the lowest direction that was
    weighed.
    """
    lowest = float(elevations(torch.cat([advice.weighed, advice.taken])).min()) - 6.0
    rim = _away(max(lowest, -90.0))

    def at(direction: Tensor) -> list[tuple[float, float]]:
        turned = torch.deg2rad(azimuths(direction) - advice.front)
        away = torch.tensor([_away(e) for e in elevations(direction).tolist()]) / rim * RADIUS
        return list(
            zip((away * turned.sin()).tolist(), (away * turned.cos()).tolist(), strict=True)
        )

    dot = RADIUS * math.sqrt(1.6 / max(len(advice.weighed), 1))
    most = max(float(advice.worth.max()), 2 * advice.least, 1e-9)
    colors = heat(advice.worth[None], most)[0]
    parts = [f'<circle r="{RADIUS:.0f}" class="sky"/>']
    for (x, y), color, gap in zip(at(advice.weighed), colors, advice.gap.tolist(), strict=True):
        ink = "".join(f"{round(255 * c):02x}" for c in color)
        kind = ' class="gap"' if gap else ""
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{dot:.1f}" fill="#{ink}"{kind}/>')
    for up in RINGS:
        ring = _away(up) / rim * RADIUS
        if up >= lowest and ring <= RADIUS:
            kind = "horizon" if up == 0 else "ring"
            parts.append(f'<circle r="{ring:.1f}" class="{kind}"/>')
            parts.append(f'<text y="{-ring - 2:.1f}" class="small">{up}°</text>')
    for (x, y), name in zip(at(advice.taken), advice.names, strict=True):
        title = f"<title>{html.escape(name)}</title>"
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" class="taken">{title}</circle>')
    for k, (x, y) in enumerate(at(advice.chosen)):
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="10" class="next"/>')
        parts.append(f'<text x="{x:.1f}" y="{y + 4.5:.1f}" class="number">{k + 1}</text>')
    far = RADIUS + 18
    words = ((0, far + 4, "front"), (far, 4, "right"), (0, -far + 6, "back"), (-far, 4, "left"))
    parts += [f'<text x="{x:.0f}" y="{y:.0f}">{word}</text>' for x, y, word in words]
    side = RADIUS + ROOM
    box = f"{-side:.0f} {-side:.0f} {2 * side:.0f} {2 * side:.0f}"
    label = "Directions around the object, seen from above"
    return (
        f'<svg class="sphere" viewBox="{box}" role="img" aria-label="{label}">{_join(parts)}</svg>'
    )


def _away(elevation: float) -> float:
    """Distance from the middle that keeps areas: 0 at the zenith, 1 at the nadir."""
    return math.sqrt((1 - math.sin(math.radians(elevation))) / 2)


def chart(curve: Curve, ends: Sequence[float]) -> str:
    """A curve over the seconds of training, with lines where stages end."""
    points = [point for piece in curve.pieces for point in piece]
    if not points:
        return ""
    values = [_scaled(curve, y) for _, y in points]
    low, high = min(values), max(values)
    margin = 0.06 * (high - low) or 0.5
    low, high = low - margin, high + margin
    last = max([x for x, _ in points] + list(ends)) or 1.0

    def place(x: float, y: float) -> str:
        across = LEFT + (WIDTH - LEFT - 8) * x / last
        down = TOP + (HEIGHT - TOP - BOTTOM) * (high - _scaled(curve, y)) / (high - low)
        return f"{across:.1f},{down:.1f}"

    parts = [f'<text x="{LEFT:.0f}" y="10" class="title">{html.escape(curve.title)}</text>']
    floor = HEIGHT - BOTTOM
    for value in _ticks(low, high):
        shown = 10**value if curve.logarithmic else value
        y = place(0.0, shown).split(",")[1]
        parts.append(f'<path d="M{LEFT:.0f} {y}H{WIDTH - 8:.0f}" class="grid"/>')
        parts.append(f'<text x="{LEFT - 6:.0f}" y="{y}" dy="4" class="end">{shown:.2g}</text>')
    for end in ends:
        x = place(end, points[0][1]).split(",")[0]
        parts.append(f'<path d="M{x} {TOP}V{floor}" class="stage"/>')
    for x in _ticks(0.0, last):
        across = place(x, points[0][1]).split(",")[0]
        parts.append(f'<text x="{across}" y="{HEIGHT - 8:.0f}">{x:g} s</text>')
    for piece in curve.pieces:
        if len(piece) == 1:
            x, y = place(*piece[0]).split(",")
            parts.append(f'<circle cx="{x}" cy="{y}" r="2.5" class="point"/>')
        elif piece:
            line = " ".join(place(x, y) for x, y in piece)
            parts.append(f'<polyline points="{line}" class="curve"/>')
    label = html.escape(curve.title)
    box = f"0 0 {WIDTH:.0f} {HEIGHT:.0f}"
    return (
        f'<svg class="chart" viewBox="{box}" role="img" aria-label="{label}">{_join(parts)}</svg>'
    )


def _scaled(curve: Curve, value: float) -> float:
    return math.log10(max(value, 1e-9)) if curve.logarithmic else value


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers within a range."""
    raw = max(high - low, 1e-9) / TICKS
    unit = 10 ** math.floor(math.log10(raw))
    step = next(unit * k for k in (1, 2, 5, 10) if unit * k >= raw)
    first = math.ceil(low / step)
    return [step * k for k in range(first, math.floor(high / step) + 1)]


def _join(parts: Sequence[str]) -> str:
    return "\n".join(parts)
