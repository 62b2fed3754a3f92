"""A trained scene against the truth of its test views: the measures, and pictures of them."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from json import dumps
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from rich.table import Table

from univoxel.bars import track
from univoxel.checkpoint import FILE, load_checkpoint
from univoxel.confidence.doubts import Doubts
from univoxel.confidence.report import numbers, words
from univoxel.confidence.survey import POINTS, Survey, survey
from univoxel.data import Photos
from univoxel.data.images import write_exr, write_png
from univoxel.envmap import tables
from univoxel.errors import UserError
from univoxel.evaluation.fitted_light import fit_light_
from univoxel.evaluation.measures import (
    MEASURES,
    Pairs,
    Scales,
    albedo_scales,
    doubt_correlation,
    doubts_and_errors,
    mesh_chamfer,
    score,
)
from univoxel.evaluation.panels import panels_of_view
from univoxel.evaluation.truth import SceneTruth, every_nth, expected_view, load_scene_truth
from univoxel.files import replacing
from univoxel.names import BOUNCES, SAMPLES, Behind
from univoxel.pictures.contact_sheet import contact_sheet
from univoxel.pictures.layers import Relighting, exr_channels, render_layers
from univoxel.records import Mesh
from univoxel.render.pipeline import extract_mesh
from univoxel.render.relight import Lighting, traced_mesh
from univoxel.run import photos_of
from univoxel.scene import Scene
from univoxel.verdict import load_verdict

SHEET_ROWS = 12  # views on the contact sheet, at most

log: logging.Logger = logging.getLogger("univoxel")


@dataclass(frozen=True)
class _ViewMeasures:
    """What the test views say, view by view."""

    measures: dict[str, list[float]]  # by key
    albedo_doubts: list[Pairs]
    roughness_doubts: list[Pairs]


@dataclass(frozen=True)
class _Protocol:
    """How novel views are compared with photographs."""

    background: Behind
    fit_light: bool


@torch.no_grad()
def evaluate(
    run: str | Path,
    data: str | Path | None = None,
    save: str | Path | None = None,
    json: str | Path | None = None,
    samples: int = SAMPLES,
    bounces: int = BOUNCES,
    light_of: str | None = None,
    test_every: int | None = None,
    background: Behind = "black",
    fit_light: bool = False,
) -> dict[str, float | int | None]:
    """Measures of a trained scene on its test views, by the keys of `MEASURES`.

    Pictures are compared as sRGB in [0, 1], whole image, composited on black, novel views on
    `background`. Numbers are means over the views (and maps) of numbers per view;
    `univoxel.evaluation.measures` and `univoxel.metrics` define each. What is weakly determined is
    said in words through the log.

    A measure that the data has no truth for is None.

    Args:
        run: folder of the trained scene.
        data: folder of the data set; the one it was trained on when left out.
        save: folder for <name>.exr of each view, contact_sheet.png, and trust.txt, what is weakly
            determined. The channels are half floats: rgb.*, albedo.* and relit_<map>.* linear,
            composited on black, with the albedo as it is; roughness, normal.* (world), doubt.albedo
            and doubt.roughness in [0, 1], 0 where nothing is; alpha; depth along -Z, 0 where
            nothing is.
        json: file for the measures; `complete` and `verdict`, how training came out, None where
            that is not known; and the figures of trust.txt under the key trust.
        samples: light samples per pixel of relit pictures.
        bounces: reflections between parts of the object in relit pictures, 0 for none.
        light_of: training view, by name or number, whose light novel views are rendered in, where
            light varies; their mean when left out.
        test_every: the first of every so many photographs, in order of all their names, instead of
            the whole test split. None of them may have been trained on.
        background: what novel views are composited on.
        fit_light: each novel view is rendered in the light in which it looks most like its
            photograph, see `fit_light_`: what is measured then is geometry and materials.

    Raises:
        DataError: the run or the data cannot be read.
        UserError: samples, bounces or test_every out of range; light_of is no training view, or
            light does not vary; both light_of and fit_light.
        OSError: a result cannot be written.
    """
    _check(samples, bounces, light_of, fit_light)
    run = Path(run)
    data, save, json = (None if path is None else Path(path) for path in (data, save, json))
    photos = photos_of(run, data)
    if test_every is not None:
        photos = every_nth(photos, photos_of(run, data, "train").names, test_every)
    truth = load_scene_truth(photos)
    scene, report = load_checkpoint(run)
    scene.show_light_of(light_of)
    for folder in (save, json and json.parent):
        if folder:
            folder.mkdir(parents=True, exist_ok=True)

    surveyed = _survey(scene, run, data)
    mesh = extract_mesh(scene) if truth.maps or truth.points is not None else None
    scales = albedo_scales(scene, photos)
    relighting = _relighting(scene, mesh, truth, scales, samples, bounces)
    protocol = _Protocol(background, fit_light)
    views = _measure_views(scene, photos, truth, scales, relighting, surveyed, protocol, save)
    result = {key: fmean(values) if values else None for key, values in views.measures.items()}
    result |= {
        "chamfer": mesh_chamfer(mesh, truth.points),
        "trust_spearman": doubt_correlation(views.albedo_doubts),
        "trust_spearman_roughness": doubt_correlation(views.roughness_doubts),
        **_costs(run, scene, report),
    }
    figures = _say_trust(surveyed, report.get("troubles", []), save)
    if json:
        with replacing(json) as temporary:
            text = dumps(result | _verdict(run) | figures, indent=2)
            temporary.write_text(text + "\n", encoding="utf-8")
    return result


def _check(samples: int, bounces: int, light_of: str | None, fit_light: bool) -> None:
    if samples < 1 or bounces < 0:
        raise UserError(
            f"evaluate: expected samples >= 1 and bounces >= 0, got {samples} and {bounces}",
            "samples",
            "bounces",
        )
    if fit_light and light_of is not None:
        raise UserError("light_of and fit_light exclude one another", "light_of", "fit_light")


def table(result: dict[str, float | int | None]) -> Table:
    """The measures as the command prints them."""
    rows = Table("measure", "meaning", "value", title="Test views")
    rows.columns[2].justify = "right"
    for key, meaning in MEASURES.items():
        value = result[key]
        text = "-" if value is None else f"{value:.4g}" if isinstance(value, float) else f"{value}"
        rows.add_row(key, meaning, text)
    return rows


def _costs(run: Path, scene: Scene, report: dict) -> dict[str, float | int | None]:
    """What training took, and the size of the model."""
    return {
        "train_seconds": report.get("seconds"),
        "threads": report.get("threads"),
        "peak_rss_mb": report.get("peak_rss_mb"),
        "parameters": sum(p.numel() for p in scene.parameters()),
        "model_bytes": (run / FILE).stat().st_size,
    }


def _verdict(run: Path) -> dict[str, Any]:
    """How training came out, for JSON."""
    verdict = load_verdict(run)
    if verdict is None:
        return {"complete": None, "verdict": None}
    return {"complete": verdict.complete, "verdict": verdict.word}


def _relighting(
    scene: Scene,
    mesh: Mesh | None,
    truth: SceneTruth,
    scales: Scales,
    samples: int,
    bounces: int,
) -> Relighting | None:
    """What test views are relit with, where there are maps to relight them under."""
    if not truth.maps or mesh is None:
        return None
    lights = {name: Lighting(tables(envmap)) for name, envmap in truth.maps.items()}
    traced = traced_mesh(mesh, scene.field.voxel_size)
    return Relighting(lights, traced, scales.three, samples, bounces)


def _measure_views(
    scene: Scene,
    photos: Photos,
    truth: SceneTruth,
    scales: Scales,
    relighting: Relighting | None,
    surveyed: Survey | None,
    protocol: _Protocol,
    save: Path | None,
) -> _ViewMeasures:
    """Render and measure all test views; write their layers and the contact sheet into `save`."""
    doubts = Doubts(surveyed) if surveyed else None
    found = _ViewMeasures({key: [] for key in MEASURES}, [], [])
    every = -(-len(photos) // SHEET_ROWS)
    rows = []
    for view in track(range(len(photos)), "rendering test views"):
        if protocol.fit_light:
            fit_light_(scene, photos, view)
        layers = render_layers(scene, photos.cameras, view, relighting, doubts)
        expected = expected_view(photos, truth.relit, view, protocol.background)
        for key, value in score(layers, expected, scales):
            found.measures[key].append(value)
        albedo, roughness = doubts_and_errors(layers, expected, scales)
        found.albedo_doubts.append(albedo)
        found.roughness_doubts.append(roughness)
        if save:
            write_exr(save / f"{photos.names[view]}.exr", exr_channels(layers))
            if view % every == 0:
                rows.append((photos.names[view], panels_of_view(layers, expected, scales)))
    if save:
        write_png(save / "contact_sheet.png", contact_sheet(rows))
    return found


def _survey(scene: Scene, run: Path, data: Path | None) -> Survey | None:
    """What the photographs that were trained on fix; None, with a line, where they are missing."""
    try:
        return survey(scene, photos_of(run, data, "train"), POINTS)
    except UserError as error:  # no photographs to train on, or no surface
        log.info("no trust report: %s", error, extra={"arguments": error.arguments})
        return None


def _say_trust(
    surveyed: Survey | None, troubles: list[str], save: Path | None
) -> dict[str, dict[str, float]]:
    """Say what is weakly determined, and write it to `save`; its figures under the key trust."""
    if surveyed is None:
        return {}
    figures = numbers(surveyed)
    paragraph = words(figures, troubles)
    log.info(paragraph)
    if save:
        with replacing(save / "trust.txt") as temporary:
            temporary.write_text(paragraph + "\n", encoding="utf-8")
    return {"trust": figures}
