"""The bundled scene, from photographs to a relightable web page."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from univoxel.cli.evaluate import evaluate
from univoxel.cli.export import export
from univoxel.cli.parsing import takes, written
from univoxel.cli.relight import relight_to_files

SCENE = Path(__file__).parent.parent / "example_data" / "tiny"
MAPS = ("city", "sunset")
FINENESS = 0.3  # of the preset's voxels
MINUTES = 2.0  # of training: the whole takes less than twice that on two cores

TITLE = "Half an avocado and a bell pepper"
NOTES = (
    "Trained on {photos} photographs on this machine's CPU. The same folder contains the run "
    "(run/), its surface (mesh.ply), the test views beside the ground truth "
    "(test/contact_sheet.png), and the test views under two environment maps that training "
    "never saw (relight/)."
)


@dataclass(frozen=True)
class DemoOptions:
    out: Annotated[Path, written("DIR")] = Path("univoxel-demo")
    """folder to write to; when done, open DIR/index.html in a browser"""


@takes(DemoOptions)
def command(asked: DemoOptions) -> Path:
    """Train, evaluate and relight the bundled scene in a few minutes."""
    from univoxel.cli.trainer import train
    from univoxel.config import StageConfig
    from univoxel.evaluation.measures import in_words
    from univoxel.output.page import write_page
    from univoxel.presets import preset
    from univoxel.scene import FILE

    out = asked.out
    run = out / "run"
    config = preset("fast", data=SCENE, out=run)
    # A voxel as wide as a pixel of these small pictures: finer ones would only fit noise.
    stages = tuple(
        replace(stage, voxels=FINENESS * stage.voxels) if isinstance(stage, StageConfig) else stage
        for stage in config.stages
    )
    config = replace(config, stages=stages, minutes=MINUTES)
    train(config, resume=(run / FILE).exists())  # one that is there is trained to its end
    measures = evaluate(run, save=out / "test")
    relight_to_files(run, [SCENE / "envmaps" / f"{name}.hdr" for name in MAPS], out / "relight")
    export(run, out / "mesh.ply")

    photos = len(list((SCENE / "train").glob("*.png")))
    return write_page(
        run,
        out / "index.html",
        title=TITLE,
        notes=NOTES.format(photos=photos),
        measures=in_words(measures),
    )
