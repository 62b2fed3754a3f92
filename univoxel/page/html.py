"""HTML of pages that need no other file and no network: text, tables and pictures."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

import numpy as np
from PIL import Image
from torch import Tensor

from univoxel import __version__
from univoxel.files import replacing

QUALITY = 85  # of JPEG
POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"  # no scripts
VIEWPORT = "width=device-width, initial-scale=1"
DARK_STYLE = "body { font: 15px/1.4 sans-serif; margin: 2em; background: #202020; color: #eee }"


def document(
    title: str, style: str, body: str, policy: str = POLICY, viewport: str = VIEWPORT
) -> str:
    """A whole page.

    Args:
        body: HTML, as all but the title.
        policy: what a browser lets the page load and run.
    """
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


def write_html(path: Path, text: str) -> None:
    """Write a page, whole or not at all.

    Raises:
        OSError: it cannot be written.
    """
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def paragraph(text: str) -> str:
    """Text as a paragraph; nothing of no text."""
    return f"<p>{escape(text)}</p>" if text else ""


def table(
    rows: Iterable[Sequence[str]], head: Sequence[str] = (), kinds: Iterable[str] | None = None
) -> str:
    """A table of cells of HTML.

    Args:
        kinds: a class for each row.
    """
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
