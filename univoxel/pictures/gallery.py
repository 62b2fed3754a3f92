"""A page of pictures that holds them all and needs no other file."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from univoxel.files import replacing

_PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>{name}</title>
<style>
body {{ font: 16px/1.5 sans-serif; max-width: 72em; margin: 2em auto; padding: 0 1em }}
img {{ display: block; max-width: 100%; background: #000 }}
img.small {{ width: 200px }}
img.pixels {{ width: 200px; image-rendering: pixelated }}
img.wide {{ width: 100% }}
div.wide {{ overflow-x: auto }}
div.wide img {{ max-width: none }}
.row {{ display: flex; flex-wrap: wrap; gap: 6px; align-items: center; margin: 6px 0 }}
.row b {{ width: 5em; font-weight: normal }}
td {{ padding-right: 2em }}
td:last-child {{ text-align: right }}
pre {{ white-space: pre-wrap }}
</style>
<h1>{title}</h1>
{parts}
</html>
"""


def write_gallery(path: Path, name: str, title: str, parts: Iterable[str]) -> None:
    """Write a page, whole or not at all.

    Args:
        name: of the window.
        title: above all.
        parts: HTML, as the functions below make it.

    Raises:
        OSError: it cannot be written.
    """
    text = _PAGE.format(name=html.escape(name), title=html.escape(title), parts="\n".join(parts))
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def row(label: str, pictures: Sequence[Path], kind: str) -> str:
    """Pictures side by side.

    Args:
        kind: as of `image`.
    """
    images = "".join(image(picture, kind) for picture in pictures)
    return f'<div class="row"><b>{html.escape(label)}</b>{images}</div>'


def sheet(picture: Path) -> str:
    """A picture in its own size, to scroll over."""
    return f'<div class="wide">{image(picture)}</div>'


def table(meanings: Mapping[str, str], values: Mapping[str, float | int | None]) -> str:
    """Numbers with what they mean, in the order of the meanings."""
    rows = [
        f"<tr><td>{html.escape(meaning)}<td>{_text(values[key])}"
        for key, meaning in meanings.items()
    ]
    return f"<table>{chr(10).join(rows)}</table>"


def image(path: Path, kind: str = "") -> str:
    """A picture, embedded.

    Args:
        kind: small; pixels, small with its pixels to be seen; wide, as wide as the page.
    """
    data = base64.b64encode(path.read_bytes()).decode()
    return f'<img class="{kind}" alt="{html.escape(path.stem)}" src="data:image/png;base64,{data}">'


def _text(value: float | int | None) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else f"{value:,}"
