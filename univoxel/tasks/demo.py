"""The bundled scene from photographs to a page of pictures."""

from __future__ import annotations

import base64
import html
import time
from pathlib import Path

from univoxel.config import preset
from univoxel.tasks.evaluate import evaluate
from univoxel.tasks.export import export
from univoxel.tasks.relight import relight
from univoxel.tasks.train import train

SCENE = Path(__file__).parent.parent / "example_data" / "tiny"
MAPS = ("city", "sunset")

_PAGE = """<!doctype html>
<meta charset="utf-8">
<title>univoxel demo</title>
<style>
body {{ font: 16px/1.5 sans-serif; max-width: 60em; margin: 2em auto; padding: 0 1em }}
img {{ min-width: 200px; max-width: 100%; image-rendering: pixelated; background: #000 }}
figure {{ display: inline-block; margin: 4px; text-align: center; font-size: 13px }}
td {{ padding-right: 2em }}
</style>
<h1>univoxel: from {photos} photographs to a relightable object</h1>
<p>Trained in {minutes:.1f} minutes on this machine's CPU. Beside this page: the run
(<code>run/</code>) and its mesh (<code>mesh.ply</code>).</p>
{sections}
<h2>Measures on the test views</h2>
<table>{rows}</table>
"""


def demo(out: Path) -> Path:
    """Train on the bundled scene, evaluate, relight under two maps; returns the page to open.

    Writes into `out`: run/, test/ (what `univoxel eval --save` writes), relight/<map>/, mesh.ply
    and index.html, which holds its pictures and needs no other file.

    Raises:
        OSError: `out` cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    run = out / "run"
    start = time.monotonic()
    train(preset("fast", data=SCENE, out=run))
    minutes = (time.monotonic() - start) / 60
    measures = evaluate(run, save=out / "test")
    for name in MAPS:
        relight(run, SCENE / "envmaps" / f"{name}.hdr", out / "relight" / name, cameras="test")
    export(run, out / "mesh.ply")

    views = sorted(p.stem for p in (SCENE / "test").glob("*.png"))
    sections = [
        _section("Test views, never trained on", out / "test", ["contact_sheet"]),
        _section("Photographs of these views", SCENE / "test", views),
    ]
    for name in MAPS:
        sections.append(_section(f"Relit: {name}", out / "relight" / name, views))
        sections.append(_section(f"Truth: {name}", SCENE / "relight" / name, views))
    rows = (
        f"<tr><td>{html.escape(str(name))}<td>{_text(value)}" for name, value in measures.items()
    )
    page = out / "index.html"
    page.write_text(
        _PAGE.format(
            photos=len(list((SCENE / "train").glob("*.png"))),
            minutes=minutes,
            sections="\n".join(sections),
            rows="\n".join(rows),
        ),
        encoding="utf-8",
    )
    return page


def _section(title: str, folder: Path, views: list[str]) -> str:
    """A heading and the pictures of a folder, embedded, view by view."""
    figures = [
        f'<figure><img alt="{path.stem}" src="data:image/png;base64,'
        f'{base64.b64encode(path.read_bytes()).decode()}"><br>'
        f"{html.escape(path.relative_to(folder).with_suffix('').as_posix())}</figure>"
        for view in views
        for path in sorted(folder.rglob(f"{view}*.png"))
        if "gt" not in path.relative_to(folder).parts
    ]
    return f"<h2>{html.escape(title)}</h2>\n" + "\n".join(figures)


def _text(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else html.escape(str(value))
