"""Settings times scenes: train and evaluate each in a process of its own, keep what comes out."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from lab import worker
from lab.record import RESULT, Outcome, Setting, identity, load_outcome
from univoxel.batch.jobs import Job, Result, Step, connect, run_jobs
from univoxel.core import log
from univoxel.core.machine import threads_asked
from univoxel.data import load_photos
from univoxel.errors import UserError
from univoxel.training.progress import LOG

NAME = re.compile(r"[\w.+=-]*\w[\w.+=-]*")


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
        UserError: two scenes or settings of one name; as in `run_pairs`.
        OSError: `out` cannot be written.
    """
    settings = _distinct(settings)
    pairs = [(data, setting) for data in _named(scenes) for setting in settings]
    jobs = [_job(data, setting, out, samples) for data, setting in pairs]
    for data in scenes:
        for split in ("train", "test"):
            config = settings[0].config(data, out)
            load_photos(data, split, config.downscale, allow_outside=config.allow_outside)
    return _run(jobs, at_once, scheduler)


def run_pairs(
    pairs: Sequence[tuple[Path, Setting]],
    out: Path,
    samples: int = 64,
    *,
    at_once: int = 1,
    scheduler: str | None = None,
) -> list[Outcome]:
    """Train scenes with settings of their own.

    out/SCENE/SETTING/ holds the run, what it said (job.txt) and result.json, an `Outcome`. A
    training whose result.json is there already is not done again; one that failed is. A failure is
    an outcome like others, that of a scene that cannot be read too: the rest continues.

    Args:
        pairs: scenes are told apart by the names of their folders.
        samples: of the light per pixel of relit pictures in evaluation, >= 1.
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
    jobs = [_job(data.resolve(), setting, out, samples) for data, setting in pairs]
    return _run(jobs, at_once, scheduler)


def _run(jobs: Sequence[Job], at_once: int, scheduler: str | None) -> list[Outcome]:
    done = {}
    for job in jobs:
        found = load_outcome(job.files.parent)
        if found is not None and found.identity != job.identity["training"]:
            raise UserError(
                f"{job.files.parent / RESULT}: comes from another configuration or data set: "
                "remove it, or choose another folder for out",
                "out",
            )
        if found is not None and not found.error:
            done[job.name] = found
    missing = {job.name: job for job in jobs if job.name not in done}
    if missing:
        with connect(at_once, scheduler) as client:
            for result in run_jobs(client, [*missing.values()], len(jobs), tries=1):
                done[result.name] = _outcome(missing[result.name], result)
    return [done[job.name] for job in jobs]


def failures(outcomes: Sequence[Outcome]) -> str:
    """A line about the trainings that failed; empty if none did."""
    failed = [o for o in outcomes if o.error]
    if not failed:
        return ""
    first = f"{failed[0].scene}/{failed[0].setting}: {failed[0].error}"
    return (
        f"{len(failed)} of {len(outcomes)} training runs failed; run the same command again to "
        f"retry them. First failure: {first}"
    )


def _named(scenes: Iterable[Path]) -> list[Path]:
    """Scenes as absolute folders, whose names tell them apart."""
    folders = [Path(scene).resolve() for scene in scenes]
    if not folders:
        raise UserError("expected at least one scene (a folder of photographs), got none")
    if len({folder.name for folder in folders}) < len(folders):
        names = [str(folder) for folder in folders]
        raise UserError(f"expected scene folders with different names, got {names}")
    return folders


def _distinct(settings: Sequence[Setting]) -> Sequence[Setting]:
    names = [setting.name for setting in settings]
    bad = [name for name in names if not NAME.fullmatch(name) or names.count(name) > 1]
    if bad or not names:
        raise UserError(f"expected settings with different names, got {bad or names}")
    return settings


def _job(data: Path, setting: Setting, out: Path, samples: int) -> Job:
    """A training as a job of one step, whose identity says what the process is to do."""
    if samples < 1:
        raise UserError(f"samples must be at least 1, got {samples}", "samples")
    folder = out.absolute() / data.name / setting.name
    config = setting.config(data, folder / worker.RUN)
    asked = {"data": str(data), "setting": dataclasses.asdict(setting), "samples": samples}
    step = Step("training", ("-m", worker.__name__, str(folder)), log=config.out / LOG)
    return Job(
        f"{data.name}/{setting.name}",
        (step,),
        folder / worker.JOB,
        {"job": asked, "training": identity(config, samples)},
        threads_asked(),
    )


def _outcome(job: Job, result: Result) -> Outcome:
    """What came out of a job, which is recorded in its folder."""
    found = load_outcome(job.files.parent)
    if result.state == "done" and found is not None:
        return found
    error = "; ".join(result.errors.values()) or f"{RESULT} is missing"
    log.info("%s failed: %s", job.name, error)
    scene, _, setting = job.name.partition("/")
    failed = Outcome(scene, setting, job.identity["training"], error=error)
    failed.save(job.files.parent)
    return failed
