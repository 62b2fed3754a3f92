"""What came out of the scenes of a batch: records, batch.json and batch.csv."""

from __future__ import annotations

import csv
import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from univoxel.batch.scenes import MEASURED
from univoxel.capture.project import Project
from univoxel.errors import UserError
from univoxel.evaluation.measures import MEASURES
from univoxel.files import read_json, replacing
from univoxel.jobs.job import Job, Result
from univoxel.verdict import Word, load_verdict

DOUBTS = ("doubt_albedo", "doubt_roughness")


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
    measures: dict[str, float | int | None] = field(default_factory=dict)  # as of `evaluate`
    doubts: dict[str, float] = field(default_factory=dict)  # means over the surface, in [0, 1]

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
    doubts = {key: found["trust"][key] for key in DOUBTS if key in found.get("trust", {})}
    told = (errors, record["seconds"], verdict and verdict.word, measures, doubts)
    return SceneResult(job.name, str(data), job.name, state, *told)


def write_results(
    results: Sequence[SceneResult], options: Mapping[str, Any], out: Path, other: Path | None = None
) -> None:
    """Write batch.json and batch.csv, each whole or not at all.

    Args:
        other: one more file for what batch.json holds.
    """
    record = {"options": dict(options), "scenes": [dataclasses.asdict(r) for r in results]}
    for path in (out / "batch.json", *([other] if other else [])):
        with replacing(path) as temporary:
            text = json.dumps(record, indent=1, default=str)
            temporary.write_text(text + "\n", encoding="utf-8")
    steps = dict.fromkeys(step for result in results for step in result.seconds)
    head = ("name", "state", "verdict", "error", *(f"{step}_s" for step in steps))
    with replacing(out / "batch.csv") as temporary, temporary.open("w", encoding="utf-8") as file:
        rows = csv.DictWriter(file, (*head, *DOUBTS, *MEASURES), "", lineterminator="\n")
        rows.writeheader()
        for r in results:
            row = {"name": r.name, "state": r.state, "verdict": r.verdict, "error": r.error}
            seconds = {f"{step}_s": spent for step, spent in r.seconds.items()}
            rows.writerow(row | seconds | r.doubts | r.measures)
