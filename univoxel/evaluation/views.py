"""Test views of a scene against their ground truth: metrics, images, expected errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from univoxel.camera import Cameras
from univoxel.color import linear_to_srgb
from univoxel.core import log
from univoxel.core.choices import Behind
from univoxel.core.files import write_text
from univoxel.core.progress_bar import track
from univoxel.core.records import AlbedoNear, Mesh
from univoxel.data import Photos
from univoxel.data.images import write_exr, write_png
from univoxel.envmap import tables
from univoxel.errors import UserError
from univoxel.evaluation.confidence import (
    POINTS,
    QUANTITIES,
    ExpectedErrors,
    Survey,
    numbers,
    survey,
    words,
)
from univoxel.evaluation.measures import (
    MEASURES,
    Expected,
    Layers,
    Pairs,
    Relighting,
    Scales,
    SceneTruth,
    errors_of,
    expected_view,
    exr_channels,
    fit_light_,
    render_layers,
    score,
    true_errors,
)
from univoxel.render.pictures import Panel, contact_sheet, heat, shrink
from univoxel.render.relight import Lighting, traced_mesh
from univoxel.run import photos_of
from univoxel.scene import Scene

SHEET_ROWS = 12  # views on the contact sheet, at most
COLOR_LIMIT, ROUGHNESS_LIMIT, NORMAL_LIMIT = 0.2, 0.5, 45.0  # brightest errors on it


@dataclass(frozen=True)
class ViewMeasures:
    """What the test views say, view by view."""

    measures: dict[str, list[float]]  # by key
    errors: dict[str, list[Pairs]]  # by quantity


def relighting_of(
    scene: Scene, mesh: Mesh | None, truth: SceneTruth, scales: Scales, samples: int, bounces: int
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
    background: Behind,
    fit_light: bool,
    save: Path | None,
    albedo_near: AlbedoNear | None = None,
    novel: Callable[[Cameras, int, Tensor, Tensor], tuple[Tensor, Tensor]] | None = None,
) -> ViewMeasures:
    """Render and measure all test views; write their layers and the contact sheet into `save`.

    Args:
        background: what novel views are compared with photographs on.
        fit_light: each is rendered in the light that fits its photograph.
        albedo_near: as in `render_layers`.
        novel: `DetailedViews.render` of the detail that the run has; None: it has none.
    """
    errors = ExpectedErrors(surveyed) if surveyed else None
    found = ViewMeasures({key: [] for key in MEASURES}, {name: [] for name in QUANTITIES})
    every = -(-len(photos) // SHEET_ROWS)
    rows = []
    for view in track(range(len(photos)), "rendering test views"):
        if fit_light:
            fit_light_(scene, photos, view, albedo_near)
        layers = render_layers(scene, photos.cameras, view, relighting, errors, albedo_near)
        if novel is not None:
            rgb = novel(photos.cameras, view, layers.rgb, layers.alpha)[0]
            layers = replace(layers, rgb=rgb)
        expected = expected_view(photos, truth.relit, view, background)
        for key, value in score(layers, expected, scales):
            found.measures[key].append(value)
        for name, pairs in errors_of(layers, expected, scales).items():
            found.errors[name].append(pairs)
        if save:
            write_exr(save / f"{photos.names[view]}.exr", exr_channels(layers))
            if view % every == 0:
                rows.append((photos.names[view], panels_of_view(layers, expected, scales)))
    if save:
        write_png(save / "contact_sheet.png", contact_sheet(rows))
    return found


def panels_of_view(layers: Layers, expected: Expected, scales: Scales) -> list[Panel]:
    """What the contact sheet shows of a view. Errors of materials and normals: in the mask."""
    truth, mask = expected.truth, expected.truth.mask

    def colors(title: str, linear: Tensor, photo: Tensor | None) -> Panel:
        picture = linear_to_srgb(linear)
        error = None if photo is None else (picture - photo).abs().mean(-1)
        return Panel(title, picture, photo, error, COLOR_LIMIT)

    def gray(roughness: Tensor) -> Tensor:
        return roughness[..., None].expand(-1, -1, 3)

    def mapped(normal: Tensor) -> Tensor:
        return 0.5 * normal + 0.5 * (normal != 0).any(-1, keepdim=True)

    rough = bent = None
    if mask is not None:
        true = true_errors(layers, expected, scales)
        rough, bent = (true[n] * mask if n in true else None for n in ("roughness", "normal"))
    shown = layers.rgb + expected.behind * (1 - layers.alpha[..., None])
    panels = [
        colors("novel view", shown, expected.photo),
        colors("albedo, scaled", layers.albedo * scales.three, expected.albedo),
        Panel(
            "roughness",
            gray(layers.roughness),
            None if truth.roughness is None else gray(truth.roughness),
            rough,
            ROUGHNESS_LIMIT,
        ),
        Panel(
            "normal",
            mapped(layers.normal),
            None if truth.normal is None else mapped(truth.normal),
            bent,
            NORMAL_LIMIT,
            " degrees",
        ),
    ]
    if layers.errors is not None:  # in the colours of the errors that they should predict
        albedo = torch.from_numpy(heat(layers.errors[..., 0], COLOR_LIMIT))
        rough = torch.from_numpy(heat(layers.errors[..., 1], ROUGHNESS_LIMIT))
        predicted = "expected albedo error", albedo, rough, panels[1].error, COLOR_LIMIT
        panels.append(Panel(*predicted, heads=("expected roughness error", "albedo error")))
    panels += [
        colors(f"under {name}", layers.relit_scaled[name], photo)
        for name, photo in expected.relit.items()
    ]
    return [shrink(panel) for panel in panels]


def survey_of(scene: Scene, run: Path, data: Path | None) -> Survey | None:
    """What the photographs that were trained on fix; None, with a line, where they are missing."""
    try:
        return survey(scene, photos_of(run, data, "train"), POINTS)
    except UserError as error:  # no photographs to train on, or no surface
        log.info("expected errors are missing: %s", error, extra={"arguments": error.arguments})
        return None


def say_trust(
    surveyed: Survey | None, troubles: list[str], save: Path | None
) -> dict[str, dict[str, float]]:
    """Log the expected errors, and write them to `save`; return their figures under the key
    trust."""
    if surveyed is None:
        return {}
    figures = numbers(surveyed)
    paragraph = words(figures, troubles)
    log.debug(paragraph)
    if save:
        write_text(save / "trust.txt", paragraph + "\n")
    return {"trust": figures}
