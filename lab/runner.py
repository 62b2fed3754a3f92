"""Settings times scenes: train and evaluate each in a process of its own, keep what comes out."""

from __future__ import annotations

import dataclasses
import json
import logging
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lab import worker
from lab.record import RESULT, Outcome, Setting, identity, load_outcome
from univoxel.cluster.drive import drive
from univoxel.cluster.machines import machines
from univoxel.cluster.piece import Ended, Piece, Step
from univoxel.data import load_photos
from univoxel.errors import UserError
from univoxel.files import replacing
from univoxel.machine import threads_asked
from univoxel.training import progress
from univoxel.training.clock import expected_training

log: logging.Logger = logging.getLogger("univoxel")

OUTPUT = "output.txt"  # what the process said
LOCK = "lock"  # held by who is at work in the folder
NAME = re.compile(r"[\w.+=-]*\w[\w.+=-]*")
EVALUATION_SECONDS = 60.0  # a guess, until runs of this sitting say better


@dataclass(frozen=True)
class Job:
    """A training that is still to be done."""

    folder: Path
    scene: str
    data: Path
    setting: Setting
    samples: int
    identity: dict[str, Any]
    seconds: float  # that it may take, a guess


def run(
    scenes: Sequence[Path],
    settings: Sequence[Setting],
    out: Path,
    samples: int = 64,
    *,
    at_once: int = 1,
    scheduler: str | None = None,
) -> list[Outcome]:
    """Train every scene with every setting; by scene, then by setting. See `run_pairs`.

    Raises:
        DataError: a scene cannot be read.
        UserError: two scenes or settings of one name; as of `run_pairs`.
        OSError: `out` cannot be written.
    """
    settings = _distinct(settings)
    pairs = [(data, setting) for data in _named(scenes) for setting in settings]
    jobs = [_job(data, setting, out, samples, None) for data, setting in pairs]
    for data in scenes:
        for split in ("train", "test"):
            config = settings[0].config(data, out)
            load_photos(data, split, config.downscale, allow_outside=config.allow_outside)
    return _run(jobs, at_once, scheduler)


def run_pairs(
    pairs: Sequence[tuple[Path, Setting]],
    out: Path,
    samples: int = 64,
    seconds: float | None = None,
    *,
    at_once: int = 1,
    scheduler: str | None = None,
) -> list[Outcome]:
    """Train scenes with settings of their own.

    out/SCENE/SETTING/ holds the run, what it said (output.txt) and result.json, an `Outcome`. A
    training whose result.json is there already is not done again; one that failed is. A failure is
    an outcome like others, that of a scene that cannot be read too: the rest goes on.

    Args:
        pairs: scenes are told apart by the names of their folders.
        samples: of the light per pixel of relit pictures in evaluation, >= 1.
        seconds: what one may take, a guess for the bar; the configuration's time when left out.
        at_once: how many at once on this machine; more than one, and their times say little.
        scheduler: address of a scheduler of Dask, whose workers train; they see the same folders.

    Raises:
        UserError: a setting that no configuration follows from, a pair that comes twice, or
            results of other settings in `out`.
        MissingExtra: Dask is missing.
        ProcessFailed: the scheduler does not answer, or is gone.
        OSError: `out` cannot be written.
    """
    _named(dict.fromkeys(data for data, _ in pairs))
    for scene in dict.fromkeys(data for data, _ in pairs):
        _distinct([setting for data, setting in pairs if data == scene])
    jobs = [_job(data.resolve(), s, out, samples, seconds) for data, s in pairs]
    return _run(jobs, at_once, scheduler)


def _run(jobs: Sequence[Job], at_once: int, scheduler: str | None) -> list[Outcome]:
    before = {job.folder: load_outcome(job.folder) for job in jobs}
    for job in jobs:
        found = before[job.folder]
        if found is not None and found.identity != job.identity:
            raise UserError(
                f"{job.folder / RESULT}: is of another configuration or data set: remove it, or "
                "choose another out",
                "out",
            )
    done = {folder: found for folder, found in before.items() if found and not found.error}
    missing = [job for job in jobs if job.folder not in done]
    if missing:
        done |= _train(missing, len(jobs), at_once, scheduler)
    return [done[job.folder] for job in jobs]


def _train(
    missing: Sequence[Job], total: int, at_once: int, scheduler: str | None
) -> dict[Path, Outcome]:
    """Outcomes of jobs by their folders."""
    work = {piece.name: (piece, job) for job in missing for piece in [_begin(job)]}
    pieces = [piece for piece, _ in work.values()]
    found = {}
    with machines(at_once, scheduler) as client:
        for ended in drive(client, pieces, total, tries=1):
            job = work[ended.name][1]
            found[job.folder] = _outcome(job, ended)
    return found


def failures(outcomes: Sequence[Outcome]) -> str:
    """A line about the trainings that failed; empty if none did."""
    failed = [o for o in outcomes if o.error]
    if not failed:
        return ""
    first = f"{failed[0].scene}/{failed[0].setting}: {failed[0].error}"
    return (
        f"{len(failed)} of {len(outcomes)} trainings failed, the same command tries them again; "
        f"the first: {first}"
    )


def _named(scenes: Iterable[Path]) -> list[Path]:
    """Scenes as absolute folders, whose names tell them apart."""
    folders = [Path(scene).resolve() for scene in scenes]
    if not folders:
        raise UserError("expected a scene, a folder of photographs, or more; got none")
    if len({folder.name for folder in folders}) < len(folders):
        names = [str(folder) for folder in folders]
        raise UserError(f"expected scenes in folders of different names, got {names}")
    return folders


def _distinct(settings: Sequence[Setting]) -> Sequence[Setting]:
    names = [setting.name for setting in settings]
    bad = [name for name in names if not NAME.fullmatch(name) or names.count(name) > 1]
    if bad or not names:
        raise UserError(f"expected settings of different names, got {bad or names}")
    return settings


def _job(data: Path, setting: Setting, out: Path, samples: int, seconds: float | None) -> Job:
    if samples < 1:
        raise UserError(f"samples must be at least 1, got {samples}", "samples")
    folder = out / data.name / setting.name
    config = setting.config(data, folder / worker.RUN)
    if seconds is None:
        seconds = expected_training(config) + EVALUATION_SECONDS
    return Job(folder, data.name, data, setting, samples, identity(config, samples), seconds)


def _begin(job: Job) -> Piece:
    """The work on a job, which is written into its folder."""
    job.folder.mkdir(parents=True, exist_ok=True)
    fields = {"data": str(job.data), "setting": job.setting, "samples": job.samples}
    with replacing(job.folder / worker.JOB) as temporary:
        temporary.write_text(json.dumps(fields, default=dataclasses.asdict), encoding="utf-8")
    folder = job.folder.absolute()
    step = Step(
        "training", ("-m", worker.__name__, str(folder)), log=folder / worker.RUN / progress.LOG
    )
    return Piece(
        f"{job.scene}/{job.setting.name}",
        (step,),
        folder / LOCK,
        folder / OUTPUT,
        threads=threads_asked(),
        seconds=job.seconds,
    )


def _outcome(job: Job, ended: Ended) -> Outcome:
    """What came out of a job, which is recorded in its folder."""
    found = load_outcome(job.folder)
    if ended.state == "done" and found is not None:
        return found
    error = "; ".join(ended.errors.values()) or f"left no {RESULT}"
    log.info("%s/%s failed: %s", job.scene, job.setting.name, error)
    failed = Outcome(job.scene, job.setting.name, job.identity, error=error)
    failed.save(job.folder)
    return failed
