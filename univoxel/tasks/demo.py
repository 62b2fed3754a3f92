"""The bundled scene from photographs to a page of pictures."""

from __future__ import annotations

import html
from dataclasses import replace
from pathlib import Path

from univoxel.checkpoint import FILE
from univoxel.evaluation.measures import MEASURES
from univoxel.pictures import gallery
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

_ABOUT = """<p>Trained in {seconds:.0f} seconds on this machine's CPU. Beside this page lie the run
(<code>run/</code>), its surface (<code>mesh.ply</code>), the test views as layers
(<code>test/</code>) and the relit frames (<code>relight/</code>).</p>
<h2>A view</h2>
<p>Photograph, render, albedo, roughness, normal.</p>"""

_RELIT = """<h2>Under other light</h2>
<p>Test views, lit by environment maps that the training never saw; truth is what a path tracer
makes of the true object.</p>"""


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
    photographs = len(list((SCENE / "train").glob("*.png")))
    parts = [
        _ABOUT.format(seconds=measures["train_seconds"] or 0),
        gallery.image(run / "preview.png", "wide"),
        _RELIT,
        *(_relit(out / "relight" / name, name) for name in MAPS),
        "<h2>Measures on the test views</h2>",
        gallery.table(MEASURES, measures),
        "<h2>Test views, their truth and the error</h2>",
        gallery.sheet(out / "test" / "contact_sheet.png"),
    ]
    title = f"univoxel: from {photographs} photographs to a relightable object"
    gallery.write_gallery(page, "univoxel demo", title, parts)
    return page


def _relit(folder: Path, name: str) -> str:
    """The frames under a map in one row, their truth in another."""
    views = sorted(path.stem for path in (SCENE / "test").glob("*.png"))
    rows = [f"<h3>{html.escape(name)}</h3>"]
    for what, pictures in (("univoxel", folder), ("truth", SCENE / "relight" / name)):
        rows.append(gallery.row(what, [pictures / f"{view}.png" for view in views], "pixels"))
    return "\n".join(rows)
