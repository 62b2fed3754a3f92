"""Test views as a scene renders them against their truth: measures, pictures, and what is weak."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

from univoxel.bars import track
from univoxel.confidence.doubts import Doubts
from univoxel.confidence.report import numbers, words
from univoxel.confidence.survey import POINTS, Survey, survey
from univoxel.data import Photos
from univoxel.data.images import write_exr, write_png
from univoxel.envmap import tables
from univoxel.errors import UserError
from univoxel.evaluation.fitted_light import fit_light_
from univoxel.evaluation.measures import MEASURES, Pairs, Scales, doubts_and_errors, score
from univoxel.evaluation.panels import panels_of_view
from univoxel.evaluation.truth import SceneTruth, expected_view
from univoxel.files import replacing
from univoxel.names import Behind
from univoxel.pictures.contact_sheet import contact_sheet
from univoxel.pictures.layers import Relighting, exr_channels, render_layers
from univoxel.records import Mesh
from univoxel.render.relight import Lighting, traced_mesh
from univoxel.run import photos_of
from univoxel.scene import Scene

SHEET_ROWS = 12  # views on the contact sheet, at most

log: logging.Logger = logging.getLogger("univoxel")


@dataclass(frozen=True)
class ViewMeasures:
    """What the test views say, view by view."""

    measures: dict[str, list[float]]  # by key
    albedo_doubts: list[Pairs]
    roughness_doubts: list[Pairs]


@dataclass(frozen=True)
class Protocol:
    """How novel views are compared with photographs."""

    background: Behind
    fit_light: bool


def relighting_of(
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


def measure_views(
    scene: Scene,
    photos: Photos,
    truth: SceneTruth,
    scales: Scales,
    relighting: Relighting | None,
    surveyed: Survey | None,
    protocol: Protocol,
    save: Path | None,
) -> ViewMeasures:
    """Render and measure all test views; write their layers and the contact sheet into `save`."""
    doubts = Doubts(surveyed) if surveyed else None
    found = ViewMeasures({key: [] for key in MEASURES}, [], [])
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


def survey_of(scene: Scene, run: Path, data: Path | None) -> Survey | None:
    """What the photographs that were trained on fix; None, with a line, where they are missing."""
    try:
        return survey(scene, photos_of(run, data, "train"), POINTS)
    except UserError as error:  # no photographs to train on, or no surface
        log.info("no trust report: %s", error, extra={"arguments": error.arguments})
        return None


def say_trust(
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
