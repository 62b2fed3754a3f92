"""The process of one training: `python -m lab.worker FOLDER`.

FOLDER holds job.json, the record of the job; result.json is written into it, whole or not at all. A
process of its own gives each training a fresh peak of memory, and takes nothing down with it when
it dies. Who begins it holds the folder's lock.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import shutil
import sys
from pathlib import Path
from typing import Any

from lab.record import RESULT, Outcome, Setting, identity, load_outcome
from univoxel.batch.jobs import Job
from univoxel.cli.envmap import envmap
from univoxel.cli.evaluate import evaluate
from univoxel.cli.trainer import train
from univoxel.config import TrainConfig, check_same
from univoxel.core.system import load
from univoxel.errors import UserError
from univoxel.evaluation.recovered_map import Comparison
from univoxel.scene import load_checkpoint

JOB = "job"  # beginning of the names of its record, its lock and what it said
RUN = "run"  # the training's own folder
MAP = "envmap.exr"  # the recovered light, where the run has one


def work(folder: Path) -> None:
    """Train, evaluate and record what folder/job.json says.

    A training that was broken off starts again: one in several sittings is not what a reader of its
    figures expects. One that was finished is only evaluated; what came through in the meantime, in
    another process, stays.
    """
    job = Job(folder.name, (), folder / JOB).record()["identity"]["job"]
    setting = Setting(**job["setting"] | {"changes": tuple(job["setting"]["changes"])})
    config = setting.config(Path(job["data"]), folder / RUN)
    samples = job["samples"]
    before = load_outcome(folder)
    if before is not None and not before.error and before.identity == identity(config, samples):
        return
    (folder / RESULT).unlink(missing_ok=True)  # of a failure before
    load_average = load()
    if not finished(config):
        shutil.rmtree(config.out, ignore_errors=True)
        train(config)
    measures = {
        **evaluate(config.out, samples=samples),
        "steps_made": steps_made(config),
        **light_error(config.out, folder / MAP),
    }
    Outcome(
        folder.parent.name,
        setting.name,
        identity(config, samples),
        measures,
        read_log(config.out / "log.jsonl"),
        load_average,
    ).save(folder)


def finished(config: TrainConfig) -> bool:
    """Whether the run's folder holds the whole of this training."""
    try:
        check_same(config)
        return load_checkpoint(config.out)[1]["stage"] == len(config.stages)
    except UserError:
        return False


def steps_made(config: TrainConfig) -> float:
    """Share of the planned steps that the run made; less than 1 where time ended it."""
    made = load_checkpoint(config.out)[1]["made"]
    planned = [stage.iterations for stage in config.stages]
    return sum(m * p for m, p in zip(made, planned, strict=True)) / sum(planned)


def light_error(run: Path, file: Path) -> dict[str, float | None]:
    """How far the recovered map, which is written to a file, is from the true one, as map_*."""
    found = None
    if load_checkpoint(run)[0].environment() is not None:
        found = envmap(run, file)
    names = [f.name for f in dataclasses.fields(Comparison)]
    return {f"map_{name}": None if found is None else getattr(found, name) for name in names}


def read_log(path: Path) -> list[dict[str, Any]]:
    """What a chart needs of a training's log."""
    if not path.exists():  # over before the first report
        return []
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return [{key: line[key] for key in ("seconds", "stage", "held_out_psnr")} for line in lines]


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    work(Path(sys.argv[1]))
