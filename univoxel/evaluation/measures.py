"""Metrics of a trained scene against the ground truth of its test views, and images of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import torch
from torch import Tensor

from univoxel.camera import Cameras
from univoxel.color import linear_to_srgb, linear_to_srgb_unclipped
from univoxel.core import log
from univoxel.core.choices import Behind
from univoxel.core.files import write_text
from univoxel.core.progress_bar import track
from univoxel.core.records import AlbedoNear, Mesh, Surface
from univoxel.data import Photos, Truth, load_points, load_relit, load_truth, relight_maps
from univoxel.data.images import write_exr, write_png
from univoxel.data.photos import decode
from univoxel.envmap import EnvMap, read_map, tables
from univoxel.errors import DataError, UserError, demand
from univoxel.evaluation.confidence import (
    POINTS,
    QUANTITIES,
    ExpectedErrors,
    Survey,
    numbers,
    survey,
    words,
)
from univoxel.lights.views import ShownLight, ViewLights
from univoxel.optim import RowAdam, geometric
from univoxel.render import metrics
from univoxel.render.pictures import Panel, contact_sheet, heat, shrink
from univoxel.render.pipeline import at_rays, shade, surface_of_view
from univoxel.render.relight import Lighting, TracedMesh, relight_surface, traced_mesh
from univoxel.run import photos_of
from univoxel.scene import Scene


@dataclass(frozen=True)
class Layers:
    """One view, row 0 on top; colours linear and composited on black, the rest as it is."""

    rgb: Tensor  # [H, W, 3] physically based render
    albedo: Tensor  # [H, W, 3]
    roughness: Tensor  # [H, W], 0 where there is nothing
    normal: Tensor  # [H, W, 3] world, 0 where there is nothing
    alpha: Tensor  # [H, W]
    depth: Tensor  # [H, W] along the camera's -Z, world units, 0 where there is nothing
    relit: dict[str, Tensor]  # [H, W, 3] by map
    relit_scaled: dict[str, Tensor]  # the same with the scaled albedo
    errors: Tensor | None = None  # [H, W, 3] as expected, of QUANTITIES, 0 where there is nothing


@dataclass(frozen=True)
class Relighting:
    """How relit layers are made."""

    lights: dict[str, Lighting]  # by the name of their map
    traced: TracedMesh  # casts shadows and sends bounces
    scale: Tensor  # [3] of the albedo, for the second set of pictures
    samples: int  # of the light, per pixel
    bounces: int


def render_layers(
    scene: Scene,
    cameras: Cameras,
    view: int,
    relighting: Relighting | None = None,
    expected: ExpectedErrors | None = None,
    albedo_near: AlbedoNear | None = None,
) -> Layers:
    """Render one view. Nothing is shaded where the opacity is 0."""
    whole, wo = surface_of_view(scene, cameras, view, albedo_near)
    there = whole.opacity > 0
    width, height = cameras.size(view)
    surface, wo = at_rays(whole, there), wo[there]

    def picture(values: Tensor) -> Tensor:
        out = values.new_zeros(len(there), *values.shape[1:])
        out[there] = values
        return out.reshape(height, width, *values.shape[1:])

    opacity = surface.opacity[:, None]
    relit, relit_scaled = {}, {}
    if relighting:
        # A scale above 1 must not make a surface that reflects more than it receives.
        bright = replace(surface, albedo=(surface.albedo * relighting.scale).clamp_max(1))
        mesh = relighting.traced.mesh
        if mesh.albedo is not None:
            mesh = replace(mesh, albedo=(mesh.albedo * relighting.scale).clamp_max(1))
        scaled_mesh = replace(relighting.traced, mesh=mesh)
        for name in relighting.lights:
            relit[name] = picture(opacity * _relight(relighting, name, surface, wo))
            scaled = _relight(replace(relighting, traced=scaled_mesh), name, bright, wo)
            relit_scaled[name] = picture(opacity * scaled)
    backward = cameras.camera_to_world[view, :, 2]
    return Layers(
        rgb=picture(opacity * shade(scene, surface, wo)),
        albedo=picture(opacity * surface.albedo),
        roughness=picture(surface.roughness),
        normal=picture(surface.normal),
        alpha=picture(surface.opacity),
        depth=picture(surface.depth * (wo @ backward)),
        relit=relit,
        relit_scaled=relit_scaled,
        errors=picture(expected.at(surface.position, surface.normal)) if expected else None,
    )


def exr_channels(layers: Layers) -> dict[str, Tensor]:
    """The channels of a saved EXR file, [H, W] each: rgb.R, normal.X, relit_<map>.R and so on."""
    channels = {"alpha": layers.alpha, "depth": layers.depth, "roughness": layers.roughness}
    if layers.errors is not None:
        names = (f"expected_error.{quantity}" for quantity in QUANTITIES)
        channels |= dict(zip(names, layers.errors.unbind(-1), strict=True))
    colors = {"rgb": layers.rgb, "albedo": layers.albedo}
    colors |= {f"relit_{name}": rgb for name, rgb in layers.relit.items()}
    for name, value in colors.items():
        channels |= {f"{name}.{c}": value[..., k] for k, c in enumerate("RGB")}
    return channels | {f"normal.{c}": layers.normal[..., k] for k, c in enumerate("XYZ")}


def _relight(relighting: Relighting, name: str, surface: Surface, wo: Tensor) -> Tensor:
    return relight_surface(
        surface,
        wo,
        relighting.traced,
        relighting.lights[name],
        samples=relighting.samples,
        bounces=relighting.bounces,
    )


# The light of a test photograph, fitted to that photograph: how the field measures where light
# differs from photograph to photograph.


STEPS = 100  # of Adam, as in NeRD (Boss et al. 2021) and Neural-PIL
RAYS = 2048  # of a step
LR = 0.05, 0.005  # at the start and the end, of log gains and of codes


def fit_light_(
    scene: Scene, photos: Photos, view: int, albedo_near: AlbedoNear | None = None
) -> None:
    """Show the light in which a view looks most like its photograph; all else stays.

    That is a gain per channel and, where light varies (`SceneConfig.varying`), the code that the
    networks of light read.
    """
    whole, wo = surface_of_view(scene, photos.cameras, view, albedo_near)
    color, alpha = photos.picture(view)
    hit = (whole.opacity > 0.5) & (alpha.flatten() > 0.5)
    if scene.views is None:
        scene.views = ViewLights(("test",))
    if not hit.any():  # nothing says what the light is
        scene.views.shown = None
        return
    surface, wo = at_rays(whole, hit), wo[hit]
    target = linear_to_srgb(color.view(-1, 3)[hit])
    log_gain = torch.zeros(3, requires_grad=True)
    codes = scene.views.raw_codes
    code = None if codes is None else torch.zeros(codes.shape[1], requires_grad=True)
    optimizer = RowAdam([log_gain] if code is None else [log_gain, code])
    generator = torch.Generator().manual_seed(view)
    for step in range(STEPS):
        optimizer.param_groups[0]["lr"] = geometric(LR, step / STEPS)
        rays = torch.randint(len(wo), (min(RAYS, len(wo)),), generator=generator)
        with torch.enable_grad():
            scene.views.shown = ShownLight(log_gain.exp(), code)
            shaded = shade(scene, at_rays(surface, rays), wo[rays])
            loss = metrics.photometric(linear_to_srgb_unclipped(shaded), target[rays])
            optimizer.zero_grad()
            loss.backward()
        optimizer.step()
    fitted = None if code is None else code.detach()
    scene.views.shown = ShownLight(log_gain.detach().exp(), fitted)


# What the test views of a data set should look like.


@dataclass(frozen=True)
class SceneTruth:
    """What a data set knows beside its views, as far as it does."""

    relit: dict[str, tuple[Tensor, Tensor]]  # stored colour and alpha of the test views, by map
    maps: dict[str, EnvMap]
    points: Tensor | None  # [P, 3] of the true surface


@dataclass(frozen=True)
class Expected:
    """What a test view should look like; sRGB on black, but for the photograph."""

    photo: Tensor  # [H, W, 3]
    albedo: Tensor | None  # [H, W, 3]
    relit: dict[str, Tensor]  # [H, W, 3] by map
    truth: Truth
    behind: float = 0.0  # linear grey that the photograph, and what is compared with it, stands on


def load_scene_truth(photos: Photos) -> SceneTruth:
    """The truth beside the test views; a DataError for files that do not belong to them."""
    paths = relight_maps(photos.folder)
    relit = {name: load_relit(photos, name) for name in paths}
    points = load_points(photos.folder)
    maps = {name: read_map(path) for name, path in paths.items()}
    return SceneTruth(relit, maps, points)


def expected_view(
    photos: Photos, relit: dict[str, tuple[Tensor, Tensor]], view: int, background: Behind = "black"
) -> Expected:
    """The truth of one test view; a DataError for files that do not belong to it.

    Args:
        relit: as in `SceneTruth`.
        background: what the photograph is composited on.
    """
    truth = view_truth(photos, view)
    color, alpha = photos.picture(view)
    behind = 1.0 if background == "white" else 0.0
    photo = color * alpha[..., None] + behind * (1 - alpha[..., None])
    return Expected(
        photo=linear_to_srgb(photo),
        albedo=None if truth.albedo is None else metrics.on_black(truth.albedo, alpha),
        relit={
            name: metrics.on_black(*decode(*(photos.cameras.cut(view, x[view]) for x in stored)))
            for name, stored in relit.items()
        },
        truth=truth,
        behind=behind,
    )


def every_nth(photos: Photos, trained: list[str], every: int) -> Photos:
    """The first of every so many photographs, in order of the names of all; a UserError if
    some were trained on, or none is left.

    Args:
        photos: that were kept for tests.
        trained: names of those that were trained on.
    """
    demand(every >= 1, "test_every", "at least 1", every)
    chosen = sorted([*photos.names, *trained])[::every]
    if seen := sorted(set(chosen) & set(trained)):
        raise UserError(
            f"test_every {every} selects {len(seen)} photographs that were used for "
            f"training, such as {seen[0]}: choose a number that selects none of these",
            "test_every",
        )
    return photos.of(torch.tensor([photos.names.index(name) for name in chosen]))


def view_truth(photos: Photos, view: int) -> Truth:
    """The layers of truth of one test view, as far as there are any."""
    truth = load_truth(photos, view)
    width, height = photos.cameras.size(view)
    if truth.mask is not None and truth.mask.shape != (height, width):
        raise DataError(
            f"{photos.folder}: expected truth of {photos.names[view]} with {width}x{height} pixels "
            f"as in the test view, got {truth.mask.shape[1]}x{truth.mask.shape[0]}"
        )
    return truth


# The metrics of a trained scene, and their definitions.
#
# - albedo_psnr_raw, _1ch, _3ch: albedo as it is; with one scale; with a scale per channel.
# - albedo_psnr_fg: as _3ch, over the pixels of the mask only.
# - relit_psnr: rendered with the albedo times the scale per channel, clipped to 1, on the surface
#   and on what it sees of itself; relit_psnr_raw: with the albedo as it is.
# - chamfer: samples of the mesh against points of the true surface.
# - trust_spearman: of the expected error (see `univoxel.evaluation.confidence`) and the true one
#   over the pixels of the mask in all views: of the albedo, with a scale per channel, mean absolute
#   difference in sRGB; of the roughness, absolute difference; of normals, the angle.


# Description of each key in the table
MEASURES = {
    "nvs_psnr": "novel views, PSNR, dB",
    "nvs_ssim": "novel views, SSIM",
    "albedo_psnr_raw": "albedo PSNR, dB, without scaling",
    "albedo_psnr_1ch": "albedo PSNR, dB, after scaling by one factor",
    "albedo_psnr_3ch": "albedo PSNR, dB, after scaling each channel",
    "albedo_psnr_fg": "albedo PSNR inside the mask, dB, after scaling each channel",
    "roughness_mse": "roughness MSE inside the mask",
    "relit_psnr": "relit PSNR, dB, after scaling each channel of the albedo",
    "relit_psnr_raw": "relit PSNR, dB, without scaling the albedo",
    "normal_mae_deg": "mean error of the normals inside the mask, degrees",
    "chamfer": "Chamfer distance, world units",
    "trust_spearman": "rank correlation between expected and true albedo error",
    "trust_spearman_roughness": "rank correlation between expected and true roughness error",
    "trust_spearman_normal": "rank correlation between expected and true normal error",
    "train_seconds": "training time, seconds",
    "threads": "threads used in training",
    "peak_rss_mb": "peak memory during training, MB",
    "parameters": "number of parameters",
    "model_bytes": "size of the model file, bytes",
}


def in_words(measures: Mapping[str, float | int | None]) -> dict[str, str]:
    """What people read of measures by key: their texts, by what they are. None is a dash."""
    return {meaning: _text(measures[key]) for key, meaning in MEASURES.items() if key in measures}


def _text(value: float | int | None) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else f"{value:,}"


SURFACE_POINTS = 100_000  # samples of the mesh for the Chamfer distance, at most

Pairs: TypeAlias = tuple[Tensor, Tensor] | None  # expected and true errors, [N] each


@dataclass(frozen=True)
class Scales:
    """What the albedo is multiplied by before it is compared; [3] each."""

    one: Tensor
    three: Tensor


def score(layers: Layers, expected: Expected, scales: Scales) -> list[tuple[str, float]]:
    """The measures of one view, by key; relit pictures give one pair of numbers for each map."""
    truth = expected.truth
    picture = linear_to_srgb(layers.rgb + expected.behind * (1 - layers.alpha[..., None]))
    found = [
        ("nvs_psnr", metrics.psnr(picture, expected.photo)),
        ("nvs_ssim", metrics.ssim(picture, expected.photo)),
    ]
    for name, photo in expected.relit.items():
        scaled, raw = layers.relit_scaled[name], layers.relit[name]
        found.append(("relit_psnr", metrics.psnr(linear_to_srgb(scaled), photo)))
        found.append(("relit_psnr_raw", metrics.psnr(linear_to_srgb(raw), photo)))
    mask = truth.mask if truth.mask is not None and truth.mask.any() else None
    if expected.albedo is not None:
        counted = {"raw": (1.0, None), "1ch": (scales.one, None), "3ch": (scales.three, None)}
        counted |= {} if mask is None else {"fg": (scales.three, mask)}
        for name, (scale, where) in counted.items():
            picture = linear_to_srgb(layers.albedo * scale)
            found.append((f"albedo_psnr_{name}", metrics.psnr(picture, expected.albedo, where)))
    if truth.roughness is not None and mask is not None:
        error = metrics.roughness_mse(layers.roughness, truth.roughness, mask)
        found.append(("roughness_mse", error))
    if truth.normal is not None and mask is not None:
        found.append(("normal_mae_deg", metrics.normal_mae(layers.normal, truth.normal, mask)))
    return found


def errors_of(layers: Layers, expected: Expected, scales: Scales) -> dict[str, Pairs]:
    """Expected and true errors in the mask of a view by quantity, None where there is no truth."""
    found: dict[str, Pairs] = dict.fromkeys(QUANTITIES)
    if layers.errors is None or expected.truth.mask is None:
        return found
    true = true_errors(layers, expected, scales)
    there = expected.truth.mask & (layers.alpha > 0)
    for k, name in enumerate(QUANTITIES):
        if name in true:
            found[name] = layers.errors[there][:, k], true[name][there]
    return found


def true_errors(layers: Layers, expected: Expected, scales: Scales) -> dict[str, Tensor]:
    """Errors [H, W] of a view by quantity, as far as there is truth."""
    truth, true = expected.truth, {}
    if expected.albedo is not None:
        difference = linear_to_srgb(layers.albedo * scales.three) - expected.albedo
        true["albedo"] = difference.abs().mean(-1)
    if truth.roughness is not None:
        true["roughness"] = (layers.roughness - truth.roughness).abs()
    if truth.normal is not None:
        cosine = (layers.normal * truth.normal).sum(-1).clamp(-1, 1)
        true["normal"] = cosine.acos().rad2deg()
    return true


def rank_correlation(pairs: list[Pairs]) -> float | None:
    """Of expected and true errors over all views; None if there is no truth."""
    known = [pair for pair in pairs if pair is not None]
    if not known:
        return None
    told, true = (torch.cat(part) for part in zip(*known, strict=True))
    return metrics.spearman(told, true)


def albedo_scales(scene: Scene, photos: Photos, albedo_near: AlbedoNear | None = None) -> Scales:
    """The scales over all test views, or 1 if there is no true albedo.

    This is a pass of its own, so that the pass that renders keeps one view in memory.
    """
    pairs = []
    for view in range(len(photos)):
        truth = view_truth(photos, view)
        if truth.albedo is not None and truth.mask is not None:
            surface, _ = surface_of_view(scene, photos.cameras, view, albedo_near)
            pairs.append((truth.albedo[truth.mask], surface.albedo[truth.mask.flatten()]))
    if not pairs:
        return Scales(torch.ones(3), torch.ones(3))
    truth, albedo = (torch.cat(part) for part in zip(*pairs, strict=True))
    everywhere = torch.ones(len(truth), dtype=torch.bool)
    one, three = (metrics.albedo_scale(truth, albedo, everywhere, c) for c in (1, 3))
    return Scales(one, three)


def mesh_chamfer(mesh: Mesh | None, points: Tensor | None) -> float | None:
    """Chamfer distance of samples of a mesh and points; None if there are none of either."""
    if mesh is None or points is None or not len(mesh.faces):
        return None
    count = min(len(points), SURFACE_POINTS)
    samples = metrics.sample_mesh(mesh, count, torch.Generator().manual_seed(0))
    return metrics.chamfer(samples, points)


# All test views of a scene: metrics, images, expected errors.


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
