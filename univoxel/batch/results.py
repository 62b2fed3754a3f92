"""What came out of the scenes of a batch: records, batch.json and batch.csv."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from univoxel.batch.scenes import measures_file
from univoxel.capture.project import Project
from univoxel.cluster.piece import Ended, Piece, load_record
from univoxel.errors import UserError
from univoxel.evaluation.measures import MEASURES
from univoxel.files import read_json, replacing

State = Literal["done", "failed", "left"]
DOUBTS = ("doubt_albedo", "doubt_roughness")


@dataclass(frozen=True)
class SceneResult:
    """What came out of a scene."""

    name: str
    data: str
    folder: str  # below that of the batch
    state: State  # left: not all of it is done yet
    errors: dict[str, str]  # a line each, by step
    seconds: dict[str, float]  # spent in all sittings, by step
    where: str  # machine that was last at work on it
    measures: dict[str, float | int | None] = field(default_factory=dict)  # as of `evaluate`
    doubts: dict[str, float] = field(default_factory=dict)  # means over the surface, in [0, 1]

    @property
    def error(self) -> str:
        """Its errors in a line."""
        return "; ".join(f"{step}: {said}" for step, said in self.errors.items())


def result_of(piece: Piece, data: Path, out: Path, ended: Ended | None = None) -> SceneResult:
    """What the files of a scene say, and how this sitting of it ended.

    Args:
        out: folder of the batch.
        ended: None: it had ended before, or has not yet.
    """
    record = load_record(piece.record)
    errors = ended.errors if ended else record.errors
    whole = all(step.done() or (step.makes is None and ended) for step in piece.steps)
    measures, doubts = _measured(measures_file(Project(out / piece.name)))
    return SceneResult(
        piece.name,
        str(data),
        piece.name,
        "failed" if errors else "done" if whole else "left",
        errors,
        record.seconds,
        ended.where if ended else record.where,
        measures,
        doubts,
    )


def write_results(results: Sequence[SceneResult], options: Mapping[str, Any], out: Path) -> None:
    """Write batch.json and batch.csv, each whole or not at all.

    Raises:
        OSError: one cannot be written.
    """
    with replacing(out / "batch.json") as temporary:
        temporary.write_text(as_json(results, options), encoding="utf-8")
    with replacing(out / "batch.csv") as temporary:
        temporary.write_text(as_csv(results), encoding="utf-8")


def as_json(results: Sequence[SceneResult], options: Mapping[str, Any]) -> str:
    """Options and scenes as JSON text."""
    scenes = [dataclasses.asdict(result) for result in results]
    return json.dumps({"options": dict(options), "scenes": scenes}, indent=1, default=str) + "\n"


def as_csv(results: Sequence[SceneResult]) -> str:
    """A row for each scene; an empty cell is not known."""
    steps = list(dict.fromkeys(step for result in results for step in result.seconds))
    head = ["name", "state", "error", "where", *(f"{step}_s" for step in steps)]
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow([*head, *DOUBTS, *MEASURES])
    for result in results:
        row = [result.name, result.state, result.error, result.where]
        row += [_cell(result.seconds.get(step)) for step in steps]
        row += [_cell(result.doubts.get(key)) for key in DOUBTS]
        rows.writerow([*row, *(_cell(result.measures.get(key)) for key in MEASURES)])
    return text.getvalue()


def _cell(value: float | int | None) -> str:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _measured(file: Path) -> tuple[dict[str, float | int | None], dict[str, float]]:
    """Measures and doubts in a file; nothing where it cannot be read."""
    try:
        found = read_json(file)
    except (OSError, UserError):
        return {}, {}
    trust = found.get("trust", {})
    return (
        {key: found[key] for key in MEASURES if key in found},
        {key: trust[key] for key in DOUBTS if key in trust},
    )
