"""A trained scene against the truth of its test views: the measures, and pictures of them."""

from __future__ import annotations

from dataclasses import dataclass
from json import dumps
from pathlib import Path
from statistics import fmean
from typing import TypeAlias

import torch
from rich import print
from rich.progress import track
from rich.table import Table
from rich.text import Text
from torch import Tensor

from univoxel import metrics
from univoxel.checkpoint import FILE, load_checkpoint
from univoxel.color import linear_to_srgb
from univoxel.confidence import Doubts, Survey, numbers, survey, words
from univoxel.data import Photos, Truth, load_points, load_relit, load_truth, relight_maps
from univoxel.data.base import decode
from univoxel.data.images import write_exr, write_png
from univoxel.data.maps import read_map
from univoxel.envmap import tables
from univoxel.errors import DataError
from univoxel.files import replacing
from univoxel.pictures.contact_sheet import Panel, contact_sheet, heat, shrink
from univoxel.pictures.layers import Layers, Relighting, exr_channels, render_layers
from univoxel.records import Mesh
from univoxel.render.pipeline import extract_mesh, surface_of_view
from univoxel.render.relight import Lighting, stage
from univoxel.run import photos_of
from univoxel.scene import Scene

# key: what the table says of it
MEASURES = {
    "nvs_psnr": "novel views, PSNR, dB",
    "nvs_ssim": "novel views, SSIM",
    "albedo_psnr_raw": "albedo PSNR, dB, as it is",
    "albedo_psnr_1ch": "albedo PSNR, dB, one scale",
    "albedo_psnr_3ch": "albedo PSNR, dB, a scale per channel",
    "albedo_psnr_fg": "albedo PSNR, dB, a scale per channel, mask only",
    "roughness_mse": "roughness MSE in the mask",
    "relit_psnr": "relit PSNR, dB, albedo with a scale per channel",
    "relit_psnr_raw": "relit PSNR, dB, albedo as it is",
    "normal_mae_deg": "normals, mean error in the mask, degrees",
    "chamfer": "Chamfer distance, world units",
    "trust_spearman": "rank correlation of the albedo's doubt with its error",
    "trust_spearman_roughness": "rank correlation of the roughness's doubt with its error",
    "train_seconds": "training, seconds",
    "threads": "threads in training",
    "peak_rss_mb": "peak memory in training, MB",
    "parameters": "parameters",
    "model_bytes": "size of the model file, bytes",
}
SURFACE_POINTS = 100_000  # samples of the mesh for the Chamfer distance, at most
SHEET_ROWS = 12  # views on the contact sheet, at most
COLOR_LIMIT, ROUGHNESS_LIMIT, NORMAL_LIMIT = 0.2, 0.5, 45.0  # brightest errors on the sheet


@dataclass(frozen=True)
class Expected:
    """What a test view should look like; sRGB on black."""

    photo: Tensor  # [H, W, 3]
    albedo: Tensor | None  # [H, W, 3]
    relit: dict[str, Tensor]  # [H, W, 3] by map
    truth: Truth


@dataclass(frozen=True)
class Scales:
    """What the albedo is multiplied by before it is compared; [3] each."""

    one: Tensor
    three: Tensor


@torch.no_grad()
def evaluate(
    run: Path,
    data: Path | None = None,
    save: Path | None = None,
    json: Path | None = None,
    samples: int = 64,
    bounces: int = 2,
    light_of: str | None = None,
) -> dict[str, float | int | None]:
    """Measure a trained scene on its test views, print the table and return it.

    Pictures are compared as sRGB in [0, 1] composited on black, whole image; numbers are means over
    the views (and maps) of numbers per view. `univoxel.metrics` defines each. In particular:

    - albedo_psnr_raw, _1ch, _3ch: albedo as it is; with one scale; with a scale per channel.
    - albedo_psnr_fg: as _3ch, over the pixels of the mask only.
    - relit_psnr: rendered with the albedo times the scale per channel, clipped to 1, on the surface
      and on what it sees of itself; relit_psnr_raw: with the albedo as it is.
    - chamfer: samples of the mesh against points of the true surface.
    - trust_spearman: of doubt (see `univoxel.confidence`) and error over the pixels of the mask in
      all views: of the albedo, with a scale per channel, mean absolute difference in sRGB; of the
      roughness, absolute difference.

    A measure that the data has no truth for is None.

    Args:
        run: folder of the trained scene.
        data: folder of the data set; the one it was trained on when left out.
        save: folder for <name>.exr of each view, contact_sheet.png, and trust.txt, what is weakly
            determined. The channels are half floats: rgb.*, albedo.* and relit_<map>.* linear,
            composited on black, with the albedo as it is; roughness, normal.* (world), doubt.albedo
            and doubt.roughness in [0, 1], 0 where nothing is; alpha; depth along -Z, 0 where
            nothing is.
        json: file for the measures, and for the figures of trust.txt under the key trust.
        samples: light samples per pixel of relit pictures.
        bounces: reflections between parts of the object in relit pictures, 0 for none.
        light_of: training view, by name or number, whose light novel views are rendered in, where
            light varies; their mean when left out.

    Raises:
        DataError: the run or the data cannot be read.
        ValueError: samples or bounces out of range; light_of is no training view, or light does not
            vary.
        OSError: a result cannot be written.
    """
    if samples < 1 or bounces < 0:
        raise ValueError(
            f"evaluate: expected samples >= 1 and bounces >= 0, got {samples} and {bounces}"
        )
    run = Path(run)
    photos = photos_of(run, data)
    relit = _relit_photos(photos)
    points = load_points(photos.folder)
    maps = {name: read_map(path) for name, path in relight_maps(photos.folder).items()}
    scene, report = load_checkpoint(run)
    scene.show_light_of(light_of)
    for place in (save, json and json.parent):
        if place:
            place.mkdir(parents=True, exist_ok=True)

    found_trust = _survey(scene, run, data)
    doubts = Doubts(found_trust) if found_trust else None
    mesh = extract_mesh(scene) if maps or points is not None else None
    scales = _albedo_scales(scene, photos)
    relighting = None
    if maps and mesh is not None:
        lights = {name: Lighting(tables(envmap)) for name, envmap in maps.items()}
        here = stage(mesh, scene.field.voxel_size)
        relighting = Relighting(lights, here, scales.three, samples, bounces)
    found: dict[str, list[float]] = {key: [] for key in MEASURES}
    every = -(-len(photos) // SHEET_ROWS)
    rows, judged = [], []
    for view in track(range(len(photos)), description="rendering test views"):
        layers = render_layers(scene, photos.cameras, view, relighting, doubts)
        expected = _expected(photos, relit, view)
        for key, value in score(layers, expected, scales):
            found[key].append(value)
        judged.append(_judged(layers, expected, scales))
        if save:
            write_exr(save / f"{photos.names[view]}.exr", exr_channels(layers))
            if view % every == 0:
                rows.append((photos.names[view], _panels(layers, expected, scales)))
    if save:
        write_png(save / "contact_sheet.png", contact_sheet(rows))

    result: dict[str, float | int | None] = {
        key: fmean(values) if values else None for key, values in found.items()
    }
    result |= {
        "chamfer": _chamfer(mesh, points),
        "trust_spearman": _foretold([j[0] for j in judged]),
        "trust_spearman_roughness": _foretold([j[1] for j in judged]),
        "train_seconds": report.get("seconds"),
        "threads": report.get("threads"),
        "peak_rss_mb": report.get("peak_rss_mb"),
        "parameters": sum(p.numel() for p in scene.parameters()),
        "model_bytes": (run / FILE).stat().st_size,
    }
    print(_table(result))
    figures = {}
    if found_trust:
        figures = {"trust": numbers(found_trust)}
        paragraph = words(figures["trust"], report.get("troubles", []))
        print(Text(paragraph))
        if save:
            with replacing(save / "trust.txt") as temporary:
                temporary.write_text(paragraph + "\n", encoding="utf-8")
    if json:
        with replacing(json) as temporary:
            text = dumps(result | figures, indent=2)
            temporary.write_text(text + "\n", encoding="utf-8")
    return result


def score(layers: Layers, expected: Expected, scales: Scales) -> list[tuple[str, float]]:
    """The measures of one view, by key; relit pictures give one pair of numbers for each map."""
    truth = expected.truth
    picture = linear_to_srgb(layers.rgb)
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
        aligned = linear_to_srgb(layers.albedo * scales.three)
        one = linear_to_srgb(layers.albedo * scales.one)
        raw = linear_to_srgb(layers.albedo)
        found.append(("albedo_psnr_raw", metrics.psnr(raw, expected.albedo)))
        found.append(("albedo_psnr_1ch", metrics.psnr(one, expected.albedo)))
        found.append(("albedo_psnr_3ch", metrics.psnr(aligned, expected.albedo)))
        if mask is not None:
            found.append(("albedo_psnr_fg", metrics.psnr(aligned, expected.albedo, mask)))
    if truth.roughness is not None and mask is not None:
        error = metrics.roughness_mse(layers.roughness, truth.roughness, mask)
        found.append(("roughness_mse", error))
    if truth.normal is not None and mask is not None:
        found.append(("normal_mae_deg", metrics.normal_mae(layers.normal, truth.normal, mask)))
    return found


def _survey(scene: Scene, run: Path, data: Path | None) -> Survey | None:
    """What the photographs that were trained on fix; None, with a line, where they are missing."""
    try:
        return survey(scene, photos_of(run, data, "train"))
    except ValueError as error:  # no photographs to train on, or no surface
        print(Text(f"no trust report: {error}"))
        return None


Pairs: TypeAlias = tuple[Tensor, Tensor] | None  # doubts and errors, [N] each


def _judged(layers: Layers, expected: Expected, scales: Scales) -> tuple[Pairs, Pairs]:
    """Doubts and errors in the mask of a view, of albedo and of roughness, where there is truth."""
    truth, doubt = expected.truth, layers.doubt
    if doubt is None or truth.mask is None:
        return None, None
    there = truth.mask & (layers.alpha > 0)
    albedo, roughness = None, None
    if expected.albedo is not None:
        error = (linear_to_srgb(layers.albedo * scales.three) - expected.albedo).abs().mean(-1)
        albedo = doubt[there][:, 0], error[there]
    if truth.roughness is not None:
        error = (layers.roughness - truth.roughness).abs()
        roughness = doubt[there][:, 1], error[there]
    return albedo, roughness


def _foretold(pairs: list[Pairs]) -> float | None:
    known = [pair for pair in pairs if pair is not None]
    if not known:
        return None
    doubt, error = (torch.cat(part) for part in zip(*known, strict=True))
    return metrics.spearman(doubt, error)


def _relit_photos(photos: Photos) -> dict[str, tuple[Tensor, Tensor]]:
    """Stored colour and alpha of the test views, by map."""
    relit = {}
    for name in relight_maps(photos.folder):
        color, alpha = load_relit(photos, name)
        _check_size(photos, alpha[0], f"pictures in relight/{name}")
        relit[name] = color, alpha
    return relit


def _truth(photos: Photos, view: int) -> Truth:
    truth = load_truth(photos, view)
    if truth.mask is not None:
        _check_size(photos, truth.mask, f"truth of {photos.names[view]}")
    return truth


def _check_size(photos: Photos, picture: Tensor, what: str) -> None:
    width, height = photos.cameras.width, photos.cameras.height
    if picture.shape != (height, width):
        raise DataError(
            f"{photos.folder}: expected {what} to have {width}x{height} pixels like the test "
            f"views, got {picture.shape[1]}x{picture.shape[0]}"
        )


def _expected(photos: Photos, relit: dict[str, tuple[Tensor, Tensor]], view: int) -> Expected:
    truth = _truth(photos, view)
    color, alpha = photos.picture(view)
    return Expected(
        photo=metrics.on_black(color, alpha),
        albedo=None if truth.albedo is None else metrics.on_black(truth.albedo, alpha),
        relit={m: metrics.on_black(*decode(c[view], a[view])) for m, (c, a) in relit.items()},
        truth=truth,
    )


def _albedo_scales(scene: Scene, photos: Photos) -> Scales:
    """The scales over all test views, or 1 where there is no true albedo.

    This is a pass of its own, so that the pass that renders keeps one view in memory.
    """
    pairs = []
    for view in range(len(photos)):
        truth = _truth(photos, view)
        if truth.albedo is not None and truth.mask is not None:
            surface, _ = surface_of_view(scene, photos.cameras, view)
            pairs.append((truth.albedo[truth.mask], surface.albedo[truth.mask.flatten()]))
    if not pairs:
        return Scales(torch.ones(3), torch.ones(3))
    truth, albedo = (torch.cat(part) for part in zip(*pairs, strict=True))
    everywhere = torch.ones(len(truth), dtype=torch.bool)
    one, three = (metrics.albedo_scale(truth, albedo, everywhere, c) for c in (1, 3))
    return Scales(one, three)


def _chamfer(mesh: Mesh | None, points: Tensor | None) -> float | None:
    if mesh is None or points is None or not len(mesh.faces):
        return None
    count = min(len(points), SURFACE_POINTS)
    samples = metrics.sample_mesh(mesh, count, torch.Generator().manual_seed(0))
    return metrics.chamfer(samples, points)


def _panels(layers: Layers, expected: Expected, scales: Scales) -> list[Panel]:
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

    rough, bent = None, None
    if truth.roughness is not None and mask is not None:
        rough = (layers.roughness - truth.roughness).abs() * mask
    if truth.normal is not None and mask is not None:
        cosine = (layers.normal * truth.normal).sum(-1).clamp(-1, 1)
        bent = cosine.acos().rad2deg() * mask
    panels = [
        colors("novel view", layers.rgb, expected.photo),
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
    if layers.doubt is not None:  # beside what it should foretell
        albedo, rough = (torch.from_numpy(heat(x, 1.0)) for x in layers.doubt.unbind(-1))
        heads = ("roughness doubt", "albedo error")
        error = panels[1].error
        panels.append(Panel("albedo doubt", albedo, rough, error, COLOR_LIMIT, heads=heads))
    panels += [
        colors(f"under {name}", layers.relit_scaled[name], photo)
        for name, photo in expected.relit.items()
    ]
    return [shrink(panel) for panel in panels]


def _table(result: dict[str, float | int | None]) -> Table:
    table = Table("measure", "meaning", "value", title="Test views")
    table.columns[2].justify = "right"
    for key, meaning in MEASURES.items():
        value = result[key]
        text = "-" if value is None else f"{value:.4g}" if isinstance(value, float) else f"{value}"
        table.add_row(key, meaning, text)
    return table
