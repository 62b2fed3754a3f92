"""Scenes as jobs: the steps of each, their results, and a web page of all."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote

from PIL import Image

from univoxel.batch.jobs import Job, Result
from univoxel.capture.project import Project
from univoxel.config import TrainConfig
from univoxel.core.files import read_json, replacing, write_json, write_text
from univoxel.core.html import DARK_STYLE, document, escape, image, paragraph, table
from univoxel.core.machine import Memory
from univoxel.data.images import image_size
from univoxel.data.load_images import LARGE
from univoxel.errors import UserError
from univoxel.evaluation.measures import MEASURES
from univoxel.run import Word, load_verdict
from univoxel.training.pixels import needed_for

MEASURED = "measures.json"  # in the folder of a scene
LOGS = "logs"  # the folder in a batch's of what processes said, records and locks
PICTURES = {".png", ".jpg", ".jpeg", ".exr"}
PER_PROCESS = 600_000_000  # bytes: Python, torch and what is loaded around them
PER_PIXEL = 7  # bytes of a photograph and its alpha


def named(scenes: Sequence[Path]) -> dict[str, Path]:
    """Absolute paths of scenes by the names of their folders; a UserError of none, two of one name,
    one that is not there, or one of a name that is taken."""
    found: dict[str, Path] = {}
    for path in (scene.resolve() for scene in scenes):
        name = path.stem if path.is_file() else path.name
        if not path.exists():
            raise UserError(f"{path}: expected a scene, but the folder does not exist")
        if name == LOGS or name.startswith("."):
            raise UserError(f"{path}: the name {name!r} is reserved: rename the folder")
        if name in found:
            both = f"{found[name]} and {path}"
            raise UserError(f"expected scene folders with different names, got {both}")
        found[name] = path
    if not found:
        raise UserError("expected at least one scene (a folder of photographs), got none")
    return found


def share(
    scenes: Collection[Path],
    config: TrainConfig,
    cores: float,
    memory: Memory | None,
    jobs: int | None = None,
    threads: int | None = None,
) -> tuple[int, int]:
    """Scenes at once, and threads of each, as cores and memory of a machine allow.

    Threads of one training wait for one another, processes do not: many of few threads do more.

    Args:
        jobs, threads: what is decided already, >= 1.
    """
    whole = max(int(cores), 1)
    if jobs is None:
        jobs = min(max(whole // (threads or 1), 1), len(scenes))
        if memory is not None and jobs > 1:
            left = memory.total if memory.free is None else memory.free
            jobs = max(min(jobs, left // max(bytes_of(data, config) for data in scenes)), 1)
    return jobs, threads or max(whole // jobs, 1)


def bytes_of(data: Path, config: TrainConfig) -> int:
    """Memory, about, of a training on the pictures below a folder."""
    pixels = 0
    for path in data.rglob("*"):
        if path.suffix.lower() in PICTURES:
            with contextlib.suppress(UserError):
                width, height = image_size(path)
                pixels += width * height
    pixels = min(pixels, LARGE) // max(config.downscale, 1) ** 2
    return PER_PROCESS + PER_PIXEL * pixels + needed_for(pixels, config)


# What came out of the scenes of a batch: records, batch.json and batch.csv.


ERRORS = ("albedo_error", "roughness_error", "normal_error")


@dataclass(frozen=True)
class SceneResult:
    """What came out of a scene."""

    name: str
    data: str
    folder: str  # below that of the batch
    state: Literal["done", "failed", "left"]  # left: not all of it is done yet
    errors: dict[str, str]  # a line each, by step
    seconds: dict[str, float]  # spent in all sittings, by step
    verdict: Word | None = None  # None: it was not trained to an end
    measures: dict[str, float | int | None] = field(default_factory=dict)  # as in `evaluate`
    expected: dict[str, float] = field(default_factory=dict)  # mean expected errors, see ERRORS

    @property
    def error(self) -> str:
        """Its errors in a line."""
        return "; ".join(f"{step}: {said}" for step, said in self.errors.items())


def result_of(job: Job, data: Path, out: Path, ended: Result | None = None) -> SceneResult:
    """What the files of a scene in the folder of a batch say, and how this sitting of it ended."""
    project, record = Project(out / job.name), job.record()
    errors = ended.errors if ended else record["errors"]
    whole = all(step.done() or (step.makes is None and ended) for step in job.steps)
    state = "failed" if errors else "done" if whole else "left"
    verdict = load_verdict(project.run)
    try:
        found = read_json(project.out / MEASURED)
    except (OSError, UserError):
        found = {}
    measures = {key: found[key] for key in MEASURES if key in found}
    expected = {key: found["trust"][key] for key in ERRORS if key in found.get("trust", {})}
    told = (errors, record["seconds"], verdict and verdict.word, measures, expected)
    return SceneResult(job.name, str(data), job.name, state, *told)


def write_results(
    results: Sequence[SceneResult], options: Mapping[str, Any], out: Path, other: Path | None = None
) -> None:
    """Write batch.json, once more as `other`, and batch.csv, each whole or not at all."""
    record = {"options": dict(options), "scenes": [dataclasses.asdict(r) for r in results]}
    for path in (out / "batch.json", *([other] if other else [])):
        write_json(path, record)
    steps = dict.fromkeys(step for result in results for step in result.seconds)
    head = ("name", "state", "verdict", "error", *(f"{step}_s" for step in steps))
    with replacing(out / "batch.csv") as temporary, temporary.open("w", encoding="utf-8") as file:
        rows = csv.DictWriter(file, (*head, *ERRORS, *MEASURES), "", lineterminator="\n")
        rows.writeheader()
        for r in results:
            row = {"name": r.name, "state": r.state, "verdict": r.verdict, "error": r.error}
            seconds = {f"{step}_s": spent for step, spent in r.seconds.items()}
            rows.writerow(row | seconds | r.expected | r.measures)


# A batch as one page: a picture of each scene, what was measured, how sure it is, what failed.


TILE = 120  # pixels of the longer side
COLUMNS = {  # measures that the page shows, by key, with their digits
    "nvs_psnr": ("novel views, dB", 1),
    "albedo_psnr_3ch": ("albedo, dB", 1),
    "roughness_mse": ("roughness, MSE", 3),
    "relit_psnr": ("relit, dB", 1),
    "normal_mae_deg": ("normals, degrees", 1),
}
WORSE_FIRST = {"failed": 0, "left": 1, "done": 2}

_STYLE = f"""{DARK_STYLE}
table {{ border-collapse: collapse }}
th, td {{ padding: 4px 12px; text-align: right; border-bottom: 1px solid #444 }}
th {{ position: sticky; top: 0; background: #202020 }}
:is(th, td):is(:nth-child(2), :nth-child(3)), td:last-child {{ text-align: left }}
td img {{ display: block }}
a {{ color: #9cf }}
.failed td {{ color: #ffb347 }}"""


def write_sheet(results: Sequence[SceneResult], out: Path) -> Path:
    """Write out/index.html, which holds its pictures; return it. Failed scenes come first."""
    shown = [key for key in COLUMNS if any(r.measures.get(key) is not None for r in results)]
    heads = ["", "scene", "verdict", *(COLUMNS[key][0] for key in shown)]
    heads += ["albedo error", "roughness error", "normal error", "training", "all", ""]
    ordered = sorted(results, key=lambda r: (WORSE_FIRST[r.state], r.name))
    counts = [(state, sum(r.state == state for r in results)) for state in WORSE_FIRST]
    about = ", ".join(f"{count} {state}" for state, count in counts if count)
    rows = table((_row(r, shown, out) for r in ordered), heads, [r.state for r in ordered])
    title, page = out.absolute().name, out / "index.html"
    body = f"<h1>{escape(title)}</h1>\n{paragraph(about)}\n{rows}"
    write_text(page, document(title, _STYLE, body))
    return page


def _row(result: SceneResult, shown: Sequence[str], out: Path) -> list[str]:
    project = Project(out / result.folder)
    cells = [_thumbnail(project.run / "preview.png"), _link(project.page, result.name, out)]
    cells.append(result.verdict or "-")
    cells += [_number(result.measures.get(key), COLUMNS[key][1]) for key in shown]
    cells += [_number(result.expected.get(key), 0 if "normal" in key else 2) for key in ERRORS]
    whole = sum(result.seconds.values()) if result.seconds else None
    cells += [_number(spent, 0, " s") for spent in (result.seconds.get("train"), whole)]
    output = _link(out / LOGS / f"{result.name}.txt", "error message", out)
    return [*cells, f"{escape(result.error)} {output}"]


def _link(path: Path, text: str, out: Path) -> str:
    """The text, as a link where there is something."""
    said = escape(text)
    if not path.exists():
        return said
    return f'<a href="{quote(path.relative_to(out).as_posix())}">{said}</a>'


def _number(value: float | int | None, digits: int, unit: str = "") -> str:
    return "-" if value is None else f"{value:.{digits}f}{unit}"


def _thumbnail(path: Path) -> str:
    """The left of a run's preview, its picture of the object, as an image in the page."""
    try:
        with Image.open(path) as picture:
            small = picture.convert("RGB")
    except (OSError, ValueError):  # none yet
        return ""
    small.thumbnail((TILE * 4, TILE), Image.Resampling.BOX)
    return image(small)
