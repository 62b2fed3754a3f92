"""Draws docs/images/rings.svg: where to photograph an object from.

python docs/figures/rings.py docs/images
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

WIDTH, HEIGHT = 860, 330
RINGS = ((0, 24, "#2b6cb0"), (40, 20, "#c05621"), (75, 6, "#2f855a"))  # elevation, number, colour
NAMES = (
    "ring 1: at its height",
    "ring 2: from above, at about 40\u00b0",
    "a few from almost overhead",
)
RADIUS = 125


def camera(x: float, y: float, degrees: float, color: str) -> str:
    """A small camera that looks along an angle, counter-clockwise from the right."""
    shape = '<rect x="-9" y="-5" width="11" height="10" rx="2"/><path d="M2 -2 L9 -6 V6 L2 2 Z"/>'
    turn = f"translate({x:.1f} {y:.1f}) rotate({-degrees:.1f})"
    return f'<g transform="{turn}" fill="{color}">{shape}</g>'


def main(out: Path) -> None:
    parts = []
    x, y = 190, 165  # seen from above
    parts.append(
        f'<circle cx="{x}" cy="{y}" r="46" fill="#edf2f7" stroke="#a0aec0" stroke-dasharray="3 3"/>'
    )
    parts.append(f'<circle cx="{x}" cy="{y}" r="20" fill="#718096"/>')
    for elevation, count, color in RINGS:
        away = RADIUS * math.cos(math.radians(elevation))
        for k in range(count):
            angle = 360 * k / count + elevation
            at = math.radians(angle)
            parts.append(
                camera(x + away * math.cos(at), y - away * math.sin(at), angle + 180, color)
            )
    x, y = 580, 255  # seen from the side
    parts.append(f'<rect x="{x - 190}" y="{y + 22}" width="380" height="5" fill="#a0aec0"/>')
    parts.append(
        f'<rect x="{x - 70}" y="{y + 17}" width="140" height="6" fill="#edf2f7" stroke="#a0aec0"/>'
    )
    parts.append(f'<rect x="{x - 20}" y="{y - 25}" width="40" height="42" rx="8" fill="#718096"/>')
    for elevation, _, color in RINGS:
        for angle in (elevation, 180 - elevation):
            at = math.radians(angle)
            px, py = x + 1.35 * RADIUS * math.cos(at), y - 1.35 * RADIUS * math.sin(at)
            parts.append(
                f'<line x1="{px:.1f}" y1="{py:.1f}" x2="{x}" y2="{y}" '
                f'stroke="{color}" opacity=".35"/>'
            )
            parts.append(camera(px, py, angle + 180, color))
    for k, ((_, _, color), name) in enumerate(zip(RINGS, NAMES, strict=True)):
        parts.append(f'<text x="{x + 30}" y="{30 + 20 * k}" fill="{color}">{name}</text>')
    parts.append('<text x="190" y="322" text-anchor="middle" fill="#4a5568">seen from above</text>')
    parts.append(
        f'<text x="{x}" y="322" text-anchor="middle" fill="#4a5568">seen from the side</text>'
    )
    text = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" '
        f'font-family="sans-serif" font-size="14">\n'
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>\n'
        + "\n".join(parts)
        + "\n</svg>\n"
    )
    (out / "rings.svg").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
