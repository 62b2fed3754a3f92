"""A report on a run: one self-contained page, without scripts, with the quality of the run, its
expected errors, and what to photograph next.

It uses no ground truth.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from univoxel import __version__
from univoxel.config import TrainConfig, load_config
from univoxel.core import log
from univoxel.core.files import write_text
from univoxel.core.html import Curve, chart, document, escape, image, paragraph, table
from univoxel.core.records import AlbedoNear, Mesh
from univoxel.errors import UserError
from univoxel.evaluation.confidence import (
    ADVICE,
    ALBEDO_LIMIT,
    POINTS,
    Advice,
    AdviceConfig,
    ExpectedErrors,
    Survey,
    advise,
    in_words,
    missing,
    numbers,
    place,
    survey,
    words,
)
from univoxel.output import report_pictures
from univoxel.output.page import START, facts_of
from univoxel.render.pipeline import extract_mesh
from univoxel.run import load_verdict, photos_of
from univoxel.scene import Scene, load_checkpoint
from univoxel.training.clock import ALL, Clock, stage_name
from univoxel.training.progress import LOG


def curves(run: Path) -> list[Curve]:
    """Loss and validation PSNR over time; empty where the log cannot be read."""
    losses: list[list[tuple[float, float]]] = []
    qualities: list[list[tuple[float, float]]] = []
    stage, resumed = None, 0.0
    try:
        for text in (run / LOG).read_text(encoding="utf-8").splitlines():
            line = json.loads(text)
            seconds = float(line["seconds"])
            if line["stage"] != stage or seconds < resumed:  # or a sitting that began again
                stage = line["stage"]
                losses.append([])
                qualities.append([])
            resumed = seconds
            if line["losses"]:
                losses[-1].append((seconds, float(sum(line["losses"].values()))))
            if line["held_out_psnr"] is not None:
                qualities[-1].append((seconds, float(line["held_out_psnr"])))
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        log.info("no curves are shown, because %s could not be read: %s", run / LOG, error)
        return []
    found = (
        Curve("loss: the sum of all terms", losses, logarithmic=True),
        Curve("validation PSNR, dB", qualities),
    )
    return [curve for curve in found if any(curve.pieces)]


def stages(cfg: TrainConfig, state: dict[str, Any]) -> list[tuple[str, ...]]:
    """The stages of a training, in order: name, planned steps, share of them that was made, time,
    and what ended it; what is not known is empty."""
    made, early, took = (list(state.get(key, ())) for key in ("made", "early", "took"))
    found = []
    for k, stage in enumerate(cfg.stages):
        share = made[k] if k < len(made) else None
        if share is None:
            fate = "not begun" if k > len(made) or not state.get("progress") else "not ended"
        elif k in early:
            fate = "ended early, because it stopped improving"
        elif share < ALL:
            fate = "stopped early" if state.get("finished") else "shortened by the time limit"
        else:
            fate = "whole"
        completed = "" if share is None else f"{share:.0%}"
        seconds = f"{took[k]:.1f} s" if k < len(took) else ""
        name = f"{k + 1}: {stage_name(cfg.stages, k)}"
        found.append((name, f"{stage.iterations:,}", completed, seconds, fate))
    return found


def stage_ends(state: dict[str, Any]) -> list[float]:
    """Seconds at which stages but the last ended; empty where that was not kept."""
    if (begin := prepared(state)) is None:
        return []
    return [begin + end for end in accumulate(state["took"][:-1])]


def prepared(state: dict[str, Any]) -> float | None:
    """Seconds of training that passed outside of stages: what was done before the first."""
    took = list(state.get("took", ()))
    if not took or "seconds" not in state:
        return None
    return max(state["seconds"] - sum(took) - state.get("stage_took", 0.0), 0.0)


def remarks(cfg: TrainConfig, state: dict[str, Any]) -> list[str]:
    """What time cut, what went wrong, what was chosen; sentences."""
    told = []
    if state.get("stage", 0) < len(cfg.stages):
        told.append(f"Training has not ended: it is in stage {state.get('stage', 0) + 1}.")
    if cut := Clock(cfg, 0.0, state).cut():
        told.append(cut[0].upper() + cut[1:] + ".")
    troubles: Sequence[str] = state.get("troubles", ())
    if troubles:
        last = f"The last one: {troubles[-1]}."
        told.append(f"Failures from which training recovered: {len(troubles)}. {last}")
    chosen = [entry.get("said", "") for entry in state.get("chosen", ())]
    return told + [f"Model size: {said}." for said in chosen if said]


FOLDER = Path(__file__).parent / "web"
RING_GAP = 60.0  # degrees between neighbouring azimuths that are worth a word, as in `poses`
TRUTH = "This report uses no ground truth: it is computed from the photographs and the model."
CHARTS = (
    "Stages minimise different losses, so the curve jumps between them. The validation PSNR "
    "measures the radiance head at first, and light and materials once they are trained."
)
LAYERS = {
    "render": "under the light of the photographs",
    "albedo": "colour without light",
    "roughness": "black is glossy, white is matte",
    "metal": "white is metal",
    "normal": "in world axes",
}


@dataclass(frozen=True)
class ReportOptions:
    """What a report shows.

    Raises:
        UserError: a number is out of range.
    """

    title: str | None = None  # None: the name of the run's folder
    data: str | Path | None = None  # folder of the photographs; None: the one that the run names
    views: int = 4  # number of photographs to show beside their render, the worst first; >= 0
    size: int = 256  # longer side of the images in pixels, >= 16
    advice: AdviceConfig = ADVICE  # how directions for more photographs are chosen
    albedo_near: AlbedoNear | None = None  # source of the albedo; None: the field

    def __post_init__(self) -> None:
        for name, least in (("views", 0), ("size", 16)):
            if (value := getattr(self, name)) < least:
                raise UserError(f"report: {name} must be at least {least}, got {value}", name)


@dataclass(frozen=True)
class Known:
    """What photographs say of a scene."""

    splits: list[report_pictures.Split]  # those trained on first, and test views, if there are any
    surveyed: Survey
    advice: Advice


def write_report(run: str | Path, path: str | Path, **options: Any) -> Path:
    """Write the report of a run as one page that opens by double click; return its path.

    Args:
        run: folder of the trained run.
        path: .html file, written whole or not at all.
        options: fields of `ReportOptions`.

    Raises:
        UserError: the run cannot be used, there is no surface, or an option is out of range; or
            `data` is given and cannot be used.
        OSError: a file cannot be read or written.
    """
    run, path = Path(run), Path(path)
    if path.suffix.lower() not in (".html", ".htm"):
        raise UserError(f"html: expected a file that ends in .html, got {path}", "html")
    asked = ReportOptions(**options)
    scene, state = load_checkpoint(run)
    text = report_text(run, scene, state, asked)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, text)
    return path


@torch.no_grad()
def report_text(
    run: Path, scene: Scene, state: dict[str, Any], options: ReportOptions = ReportOptions()
) -> str:
    """The report of a scene as HTML; errors as in `write_report`.

    Args:
        run: the scene's folder; what is missing of log, configuration and photographs is left out,
            and the page says so.
        state: of its training, as its checkpoint has it.
    """
    mesh = extract_mesh(scene)
    known, why = None, ""
    try:
        known = what_is_known(run, scene, options)
    except (UserError, OSError) as error:  # moved, or not on this machine
        if options.data is not None:
            raise
        why = f"The photographs could not be read, so this part is missing: {error}."
    title = options.title or run.resolve().name or "univoxel"
    front = START[0] if known is None else known.advice.front
    errors = None if known is None else ExpectedErrors(known.surveyed)
    pictures = report_pictures.layers(scene, mesh, options.size, front, errors, options.albedo_near)
    painted = pictures.pop("error", [])
    verdict = load_verdict(run)
    sections = [
        ("Result", paragraph(verdict.sentence() + ".") if verdict else ""),
        ("What to photograph next", next_section(known.advice) if known else paragraph(why)),
        ("Expected errors", error_section(known, state, painted) if known else ""),
        ("Photographs and renders", views_section(scene, known, options) if known else ""),
        ("Materials", materials_section(pictures)),
        ("Light", light_section(scene, mesh)),
        ("Training", training_section(run, state)),
    ]
    facts = " · ".join(facts_of(run, state.get("seconds")))
    shown = (f"<section><h2>{name}</h2>\n{text}\n</section>" for name, text in sections if text)
    body = [
        f"<header>\n  <h1>{escape(title)}</h1>\n  <p>{escape(facts)}</p>\n</header>",
        *("<main>", *shown, "</main>"),
        f"<footer>Made by univoxel {__version__}. {TRUTH}</footer>",
    ]
    return document(title, (FOLDER / "report.css").read_text("utf-8"), "\n".join(body))


def what_is_known(run: Path, scene: Scene, options: ReportOptions) -> Known:
    """Survey the surface by the photographs of a run, and weigh directions for more; errors as of
    `photos_of`."""
    data = None if options.data is None else Path(options.data)
    photos = photos_of(run, data, "train")
    surveyed = survey(scene, photos, POINTS)
    photos = scene.registered(photos)
    advice = advise(surveyed, photos.cameras, photos.names, scene.occluder(), options.advice)
    splits = [report_pictures.Split(photos, True)]
    try:
        splits.append(report_pictures.Split(photos_of(run, data, "test"), False))
    except (UserError, OSError):  # few have any
        pass
    return Known(splits, surveyed, advice)


def next_section(advice: Advice) -> str:
    """Directions for more photographs, in words, as a list and on the sphere."""
    parts = []
    if told := in_words(advice):
        text = "".join(f"<li>{escape(line)}" for line in told)
        parts.append(f'<ul class="advice">{text}</ul>')
        worth = enumerate(zip(advice.nearest, advice.gains.tolist(), strict=True))
        rows = [
            (f"{k + 1}", _direction(advice, k), escape(near), f"{gain:.1%}")
            for k, (near, gain) in worth
        ]
        parts.append(table(rows, ("", "direction", "nearest photograph", "worth")))
    else:
        parts.append(paragraph("The photographs cover all useful directions."))
    told = [f"{line[0].upper()}{line[1:]}." for line in missing(advice, RING_GAP)]
    if advice.hidden >= 0.01:
        told.append(
            f"{advice.hidden:.0%} of the surface is not seen in any photograph, nor from any of "
            "these directions: turn the object over and photograph it again, or accept the gap."
        )
    told.append(
        f"The front is the side from which {advice.front_name} was taken. Left and right are as "
        "seen from the front. Keep the distance and the light of the other photographs."
    )
    parts += [paragraph(line) for line in told]
    legend = (
        "Directions around the object, seen from above. White dots: photographs. Bright areas: "
        "a photograph from there would help. Rings: gaps without photographs. Numbers: "
        "photographs to take, the best first. Worth: the share of the surface that a "
        "photograph would show better, weighted by uncertainty."
    )
    left = "\n".join(parts)
    figure = f"<figure>{report_pictures.sphere(advice)}<figcaption>{legend}</figcaption></figure>"
    return f'<div class="beside"><div>{left}</div>{figure}</div>'


def error_section(known: Known, state: dict[str, Any], pictures: Sequence[Tensor]) -> str:
    """Expected errors, in words and painted on the object."""
    text = words(numbers(known.surveyed), list(state.get("troubles", [])))
    legend = f"Expected error of the albedo: black is 0, white is {ALBEDO_LIMIT:g} in sRGB or more."
    return paragraph(text) + gallery(zip(report_pictures.SIDES, pictures, strict=True), legend)


def views_section(scene: Scene, known: Known, options: ReportOptions) -> str:
    """Photographs beside what the scene shows from there, the worst first."""
    found, count = report_pictures.worst(
        scene, known.splits, options.views, options.size, options.albedo_near
    )
    if not found:
        return ""
    rows = []
    for view in found:
        kind = "" if view.trained else " (not trained on)"
        words = f"{view.name}{kind}: mean error {view.error:.3f} (sRGB), PSNR {view.quality:.1f} dB"
        tiles = "".join(image(tile, words) for tile in view.tiles)
        caption = f"<figcaption>{escape(words)}</figcaption>"
        rows.append(f'<figure class="row">{tiles}{caption}</figure>')
    said = (
        f"The {len(found)} of {count} compared photographs that differ most from their render. "
        "From left to right: photograph, render and difference, which is white at "
        f"{report_pictures.LIMIT} in sRGB or more. The background does not count."
    )
    return paragraph(said) + f'<div class="views">{"".join(rows)}</div>'


def materials_section(pictures: dict[str, list[Tensor]]) -> str:
    """The layers from four sides."""
    parts = [
        gallery(
            zip(report_pictures.SIDES, row, strict=True), f"{name.capitalize()}: {LAYERS[name]}."
        )
        for name, row in pictures.items()
    ]
    if "metal" not in pictures:
        parts.append(paragraph("No metal was found."))
    return "\n".join(parts)


def light_section(scene: Scene, mesh: Mesh) -> str:
    """The recovered light as a map, with a diffuse and a chrome sphere under it."""
    found = report_pictures.found_light(scene, mesh)
    if found is None:
        kind = scene.cfg.light.kind
        return paragraph(f"There is no environment map: the run was trained with {kind} light.")
    radiance, about = found
    names = ("map", "diffuse sphere", "chrome sphere")
    tiles = zip(names, report_pictures.pictures_of(radiance), strict=True)
    legend = (
        "Spheres are seen from +X, with +Z up. The brightness of each channel is unknown, "
        "because a bright light and a bright albedo look the same in photographs."
    )
    return paragraph(about) + gallery(tiles, legend, "light")


def training_section(run: Path, state: dict[str, Any]) -> str:
    """Curves, times of the stages, and what time cut."""
    parts = []
    ends = stage_ends(state)
    drawn = [chart(curve, ends) for curve in curves(run)]
    if any(drawn):
        parts.append(f'<div class="charts">{"".join(drawn)}</div>')
        parts.append(paragraph(CHARTS))
    else:
        parts.append(paragraph("There are no curves, because this run has no log."))
    try:
        cfg = load_config(run / "config.json")
    except (UserError, OSError) as error:
        log.info("the table of stages is missing: %s", error)
        return "\n".join(
            [*parts, paragraph("The table of stages is missing: config.json is not readable.")]
        )
    rows = []
    if (before := prepared(state)) is not None:
        rows.append(("preparation", "", "", f"{before:.1f} s", ""))
    rows += stages(cfg, state)
    parts.append(table(rows, ("stage", "planned steps", "completed", "time", "")))
    limit = "" if cfg.minutes is None else f"The time limit was {60 * cfg.minutes:,.0f} s."
    told = [limit, *remarks(cfg, state)]
    return "\n".join([*parts, *(paragraph(line) for line in told)])


def gallery(named: Any, legend: str, kind: str = "") -> str:
    """Pictures in a row under their names."""
    figures = "".join(
        f"<figure>{image(picture, name)}<figcaption>{name}</figcaption></figure>"
        for name, picture in named
    )
    return f'<p class="legend">{escape(legend)}</p><div class="gallery {kind}">{figures}</div>'


def _direction(advice: Advice, k: int) -> str:
    """An advised direction as side and elevation."""
    direction = advice.chosen[k]
    up = float(torch.rad2deg(direction[2].clamp(-1, 1).asin()))
    return f"{place(advice, direction)}, {abs(up):.0f}° {'above' if up >= 0 else 'below'}"
