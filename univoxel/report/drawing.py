"""Drawings of a report, as SVG in the text of a page."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from univoxel.confidence.advice import Advice, azimuths, elevations
from univoxel.page.html import escape
from univoxel.pictures.contact_sheet import heat

RADIUS = 200.0  # of the drawn sphere
ROOM = 34.0  # around it, for words
RINGS = (-60, -30, 0, 30, 60)  # elevations, degrees


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
        title = f"<title>{escape(name)}</title>"
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


def _join(parts: Sequence[str]) -> str:
    return "\n".join(parts)
