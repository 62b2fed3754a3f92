"""Metrics of a trained scene on its test views, and images of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from univoxel.cli import parsing
from univoxel.core.choices import BOUNCES, SAMPLES, Behind
from univoxel.core.files import write_json
from univoxel.errors import UserError, demand

if TYPE_CHECKING:
    from rich.table import Table


@dataclass(frozen=True)
class EvaluateOptions:
    """How a run is measured; a UserError for an option out of range, or two that exclude each
    other."""

    run: parsing.Run
    """folder of a trained run"""
    data: parsing.DataOf = None
    """folder of the photographs, if they were moved"""
    save: Annotated[parsing.File | None, parsing.written("DIR", "none are written")] = None
    """folder to write the rendered images to"""
    json: parsing.JsonFile = None
    """write the metrics to a file as JSON; use - to print them instead of the table"""
    samples: int = SAMPLES
    """number of light samples per pixel in relit images"""
    bounces: Annotated[int, parsing.ADVANCED] = BOUNCES
    """number of reflections between parts of the object in relit images"""
    light_of: parsing.LightOf = None
    """render under the light of this training view (name or number)"""
    test_every: Annotated[int | None, parsing.written("N", "the test split", advanced=True)] = None
    """test on every Nth photograph; none of these may have been used for training"""
    background: Annotated[Behind, parsing.ADVANCED] = "black"
    """background of the novel views"""
    fit_light: Annotated[bool, parsing.ADVANCED] = False
    """fit the light to each test photograph before measuring, as many papers do"""
    full_size: bool = False
    """also measure novel views at full size, with the full-size texture of the run"""

    def __post_init__(self) -> None:
        demand(self.samples >= 1, "samples", "at least 1", self.samples)
        demand(self.bounces >= 0, "bounces", "at least 0", self.bounces)
        if self.fit_light and self.light_of is not None:
            raise UserError("expected light_of or fit_light, but not both", "light_of", "fit_light")


@parsing.takes(EvaluateOptions)
def command(asked: EvaluateOptions) -> None:
    """Measure a run on its test views."""
    import rich

    with parsing.json_file(asked.json) as file:
        measures = evaluate(**vars(replace(asked, json=file)))
    if asked.json != parsing.STDOUT:
        rich.print(table(measures))


@parsing.takes(EvaluateOptions, gradients=False)
def evaluate(asked: EvaluateOptions) -> dict[str, float | int | None]:
    """Metrics of a trained scene on its test views, with the keys of `MEASURES`.

    Arguments are the fields of `EvaluateOptions`. Whole images are compared in sRGB, clipped to
    [0, 1] and composited on black, except for novel views, which are composited on `background`. If
    the run has a full-size texture, novel views use it and are corrected by nearby photographs.
    Each metric is a mean over the views (and maps); `univoxel.evaluation.measures` and
    `univoxel.render.metrics` define the metrics. A metric is None if the data set has no ground
    truth for it. The log describes what the photographs determine weakly.

    The folder `save` gets <name>.exr for each view, contact_sheet.png, and trust.txt with that
    description. The channels are half floats: rgb.*, albedo.* and relit_<map>.* are linear,
    composited on black, and the albedo is not scaled; roughness, normal.* (in world space), depth
    (along -Z) and expected_error.albedo (in sRGB), .roughness and .normal (in degrees) are 0
    outside the object; alpha is the opacity. With `full_size`, NAME_full.exr is written too, with
    rgb.* and alpha at the size of the photograph, and the result has the keys of
    `univoxel.detail.views.FULL_MEASURES`. The file `json` contains the metrics; `complete` and
    `verdict`, which are None if they are not known; and the figures of trust.txt under the key
    trust.

    Raises:
        DataError: the run or the data cannot be read.
        UserError: an argument is out of range, light_of is not a training view, or light does not
            vary.
        OSError: a result cannot be written.
    """
    from statistics import fmean

    from univoxel.detail.views import detailed_views, measure_full_size
    from univoxel.evaluation import measures
    from univoxel.render.pipeline import extract_mesh
    from univoxel.run import load_verdict, photos_of
    from univoxel.scene import FILE, load_checkpoint

    run = Path(asked.run)
    paths = asked.data, asked.save, asked.json
    data, save, json = (None if path is None else Path(path) for path in paths)
    photos = photos_of(run, data)
    if asked.test_every is not None:
        photos = measures.every_nth(photos, photos_of(run, data, "train").names, asked.test_every)
    truth = measures.load_scene_truth(photos)
    scene, report = load_checkpoint(run)
    scene.show_light_of(asked.light_of)
    for folder in (save, json and json.parent):
        if folder:
            folder.mkdir(parents=True, exist_ok=True)

    surveyed = measures.survey_of(scene, run, data)
    mesh = extract_mesh(scene) if truth.maps or truth.points is not None else None
    detailed = detailed_views(scene, run, data)
    near = None if detailed is None else detailed.detail.near
    scales = measures.albedo_scales(scene, photos, near)
    relighting = measures.relighting_of(scene, mesh, truth, scales, asked.samples, asked.bounces)
    how = {"background": asked.background, "fit_light": asked.fit_light, "save": save}
    how |= {"albedo_near": near, "novel": detailed and detailed.render}
    found = measures.measure_views(scene, photos, truth, scales, relighting, surveyed, **how)
    result = {key: fmean(values) if values else None for key, values in found.measures.items()}
    result |= {
        "chamfer": measures.mesh_chamfer(mesh, truth.points),
        "trust_spearman": measures.rank_correlation(found.errors["albedo"]),
        "trust_spearman_roughness": measures.rank_correlation(found.errors["roughness"]),
        "trust_spearman_normal": measures.rank_correlation(found.errors["normal"]),
        "train_seconds": report.get("seconds"),
        "threads": report.get("threads"),
        "peak_rss_mb": report.get("peak_rss_mb"),
        "parameters": sum(p.numel() for p in scene.parameters()),
        "model_bytes": (run / FILE).stat().st_size,
    }
    if asked.full_size:
        result |= measure_full_size(scene, detailed, photos, save, asked.fit_light)
    figures = measures.say_trust(surveyed, report.get("troubles", []), save)
    if json:
        verdict = load_verdict(run)
        came = {"complete": verdict and verdict.complete, "verdict": verdict and verdict.word}
        write_json(json, result | came | figures)
    return result


def table(result: dict[str, float | int | None]) -> Table:
    """The metrics that have a value, as the command prints them."""
    from rich.table import Table

    from univoxel.evaluation.measures import MEASURES

    rows = Table("key", "metric", "value", title="Test views")
    rows.columns[2].justify = "right"
    known = MEASURES
    if "full_psnr" in result:
        from univoxel.detail.views import FULL_MEASURES

        known = MEASURES | FULL_MEASURES
    for key, meaning in known.items():
        if (value := result[key]) is not None:
            rows.add_row(key, meaning, f"{value:.4g}" if isinstance(value, float) else f"{value}")
    return rows
