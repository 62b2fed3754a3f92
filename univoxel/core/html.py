"""HTML of self-contained pages: text, tables, images and curves."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from PIL import Image
from torch import Tensor

from univoxel import __version__

QUALITY = 85  # of JPEG
POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"  # no scripts
VIEWPORT = "width=device-width, initial-scale=1"
DARK_STYLE = "body { font: 15px/1.4 sans-serif; margin: 2em; background: #202020; color: #eee }"


def document(
    title: str, style: str, body: str, policy: str = POLICY, viewport: str = VIEWPORT
) -> str:
    """A whole page. Its body is HTML; policy is what a browser lets it load and run."""
    return f"""<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="{viewport}">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="generator" content="univoxel {__version__}">
<title>{escape(title)}</title>
<style>
{style}
</style>
<body>
{body}
</body>
</html>
"""


def paragraph(text: str) -> str:
    """Text as a paragraph; nothing of no text."""
    return f"<p>{escape(text)}</p>" if text else ""


def table(
    rows: Iterable[Sequence[str]], head: Sequence[str] = (), kinds: Iterable[str] | None = None
) -> str:
    """A table of cells of HTML, with a class for each row if there are kinds."""
    rows = list(rows)
    opened = [f'<tr class="{kind}">' for kind in kinds] if kinds else ["<tr>"] * len(rows)
    heads = "<tr>" + "".join(f"<th>{cell}" for cell in head) if head else ""
    lines = (
        opening + "".join(f"<td>{cell}" for cell in row)
        for opening, row in zip(opened, rows, strict=True)
    )
    return f"<table>{heads}{''.join(lines)}</table>"


def image(picture: Tensor | Image.Image, alt: str = "") -> str:
    """An <img> that holds a picture: [h, w, 3] in [0, 1], sRGB, or an image."""
    if isinstance(picture, Tensor):
        values = (picture.clamp(0, 1).numpy() * 255 + 0.5).astype(np.uint8)
        picture = Image.fromarray(values)
    encoded = io.BytesIO()
    picture.save(encoded, format="JPEG", quality=QUALITY)
    data = base64_text(encoded.getvalue())
    return f'<img alt="{escape(alt)}" src="data:image/jpeg;base64,{data}">'


def base64_text(data: bytes) -> str:
    """Bytes as text in a page."""
    return base64.b64encode(data).decode()


# Curves over the time of a training, as SVG in the text of a dark page.


WIDTH, HEIGHT = 560.0, 190.0
LEFT, BOTTOM, TOP = 56.0, 24.0, 12.0  # for numbers
TICKS = 4  # numbers along an axis, about
INK, GRID, STAGE, LINE = "#f1efec", "#ffffff14", "#ffffff50", "#ffb454"
STYLE = (
    'width="100%" font-family="system-ui, sans-serif" font-size="13" fill="#b4b0aa" '
    'text-anchor="middle"'
)
NUMBER = 'text-anchor="end" font-size="11"'


@dataclass(frozen=True)
class Curve:
    """A measure over time, in pieces: what lies between two of them is not joined."""

    title: str
    pieces: Sequence[Sequence[tuple[float, float]]]  # (seconds, value)
    logarithmic: bool = False


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

    def across(x: float) -> str:
        return f"{LEFT + (WIDTH - LEFT - 8) * x / last:.1f}"

    def down(scaled: float) -> str:
        return f"{TOP + (HEIGHT - TOP - BOTTOM) * (high - scaled) / (high - low):.1f}"

    title = escape(curve.title)
    parts = [f'<text x="{LEFT:.0f}" y="10" text-anchor="start" fill="{INK}">{title}</text>']
    floor = HEIGHT - BOTTOM
    for value in _ticks(low, high):
        y, shown = down(value), 10**value if curve.logarithmic else value
        parts.append(f'<path d="M{LEFT:.0f} {y}H{WIDTH - 8:.0f}" stroke="{GRID}"/>')
        parts.append(f'<text x="{LEFT - 6:.0f}" y="{y}" dy="4" {NUMBER}>{shown:.2g}</text>')
    for x in map(across, ends):
        parts.append(
            f'<path d="M{x} {TOP}V{floor}" stroke="{STAGE}" stroke-dasharray="3 3" class="stage"/>'
        )
    for x in _ticks(0.0, last):
        parts.append(f'<text x="{across(x)}" y="{HEIGHT - 8:.0f}">{x:g} s</text>')
    for piece in curve.pieces:
        placed = [(across(x), down(_scaled(curve, y))) for x, y in piece]
        if len(placed) == 1:
            x, y = placed[0]
            parts.append(f'<circle cx="{x}" cy="{y}" r="2.5" fill="{LINE}" class="point"/>')
        elif placed:
            line = " ".join(map(",".join, placed))
            parts.append(
                f'<polyline points="{line}" fill="none" stroke="{LINE}" stroke-width="1.8"/>'
            )
    box = f"0 0 {WIDTH:.0f} {HEIGHT:.0f}"
    return (
        f'<svg class="chart" viewBox="{box}" role="img" aria-label="{title}" {STYLE}>'
        f"{''.join(parts)}</svg>"
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
