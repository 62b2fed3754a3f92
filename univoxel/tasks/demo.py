"""The bundled scene from photographs to a page of pictures."""

from __future__ import annotations

import base64
import html
from dataclasses import replace
from pathlib import Path

from univoxel.checkpoint import FILE
from univoxel.evaluation.measures import MEASURES
from univoxel.files import replacing
from univoxel.presets import preset
from univoxel.tasks.evaluate import evaluate
from univoxel.tasks.export import export
from univoxel.tasks.relight import relight_to_files
from univoxel.tasks.train import train
from univoxel.training.config import StageConfig

SCENE = Path(__file__).parent.parent / "example_data" / "tiny"
MAPS = ("city", "sunset")
FINENESS = 0.3  # of the preset's voxels
MINUTES = 2.0  # of training: the whole takes less than twice that on two cores

_PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>univoxel demo</title>
<style>
body {{ font: 16px/1.5 sans-serif; max-width: 72em; margin: 2em auto; padding: 0 1em }}
img {{ display: block; max-width: 100%; background: #000 }}
img.small {{ width: 200px; image-rendering: pixelated }}
img.wide {{ width: 100% }}
div.wide {{ overflow-x: auto }}
div.wide img {{ max-width: none }}
.row {{ display: flex; flex-wrap: wrap; gap: 6px; align-items: center; margin: 6px 0 }}
.row b {{ width: 5em; font-weight: normal }}
td {{ padding-right: 2em }}
td:last-child {{ text-align: right }}
</style>
<h1>univoxel: from {photos} photographs to a relightable object</h1>
<p>Trained in {seconds:.0f} seconds on this machine's CPU. Beside this page lie the run
(<code>run/</code>), its surface (<code>mesh.ply</code>), the test views as layers
(<code>test/</code>) and the relit frames (<code>relight/</code>).</p>
<h2>A view</h2>
<p>Photograph, render, albedo, roughness, normal.</p>
{preview}
<h2>Under other light</h2>
<p>Test views, lit by environment maps that the training never saw; truth is what a path tracer
makes of the true object.</p>
{relit}
<h2>Measures on the test views</h2>
<table>{measures}</table>
<h2>Test views, their truth and the error</h2>
<div class="wide">{sheet}</div>
</html>
"""


def demo(out: str | Path) -> Path:
    """Train on the bundled scene, evaluate, relight under two maps; returns the page to open.

    Writes into `out`: run/, test/ (what `univoxel eval --save` writes), relight/<map>/, mesh.ply
    and index.html, which holds its pictures and needs no other file. A run that is there already is
    trained to its end and not again.

    Raises:
        OSError: `out` cannot be written.
        UserError: the run that is there cannot be read.
    """
    out = Path(out)
    run = out / "run"
    config = preset("fast", data=SCENE, out=run)
    # A voxel as wide as a pixel of these small pictures: finer ones would only fit noise.
    stages = tuple(
        replace(stage, voxels=FINENESS * stage.voxels) if isinstance(stage, StageConfig) else stage
        for stage in config.stages
    )
    config = replace(config, stages=stages, minutes=MINUTES)
    train(config, resume=(run / FILE).exists())
    measures = evaluate(run, save=out / "test")
    relight_to_files(run, [SCENE / "envmaps" / f"{name}.hdr" for name in MAPS], out / "relight")
    export(run, out / "mesh.ply")

    page = out / "index.html"
    text = _PAGE.format(
        photos=len(list((SCENE / "train").glob("*.png"))),
        seconds=measures["train_seconds"] or 0,
        preview=_image(run / "preview.png", "wide"),
        relit="\n".join(_relit(out / "relight" / name, name) for name in MAPS),
        measures="\n".join(
            f"<tr><td>{html.escape(meaning)}<td>{_text(measures[key])}"
            for key, meaning in MEASURES.items()
        ),
        sheet=_image(out / "test" / "contact_sheet.png"),
    )
    with replacing(page) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return page


def _relit(folder: Path, name: str) -> str:
    """The frames under a map in one row, their truth in another."""
    views = sorted(path.stem for path in (SCENE / "test").glob("*.png"))
    rows = [f"<h3>{html.escape(name)}</h3>"]
    for what, pictures in (("univoxel", folder), ("truth", SCENE / "relight" / name)):
        images = "".join(_image(pictures / f"{view}.png", "small") for view in views)
        rows.append(f'<div class="row"><b>{what}</b>{images}</div>')
    return "\n".join(rows)


def _image(path: Path, kind: str = "") -> str:
    """A picture, embedded."""
    data = base64.b64encode(path.read_bytes()).decode()
    return f'<img class="{kind}" alt="{html.escape(path.stem)}" src="data:image/png;base64,{data}">'


def _text(value: float | int | None) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else f"{value:,}"
