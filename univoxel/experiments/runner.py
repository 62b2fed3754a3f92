"""Settings times scenes: train and evaluate each in a process of its own, keep what comes out."""

from __future__ import annotations

import dataclasses
import json
import logging
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.progress import BarColumn, TextColumn, TimeElapsedColumn

from univoxel.bars import bar
from univoxel.data import load_photos
from univoxel.errors import UserError
from univoxel.experiments import worker
from univoxel.experiments.record import RESULT, Outcome, Setting, identity, load_outcome
from univoxel.files import replacing

log: logging.Logger = logging.getLogger("univoxel")

OUTPUT = "output.txt"  # what the process said
NAME = re.compile(r"[\w.+=-]*\w[\w.+=-]*")
EVALUATION_SECONDS = 60.0  # a guess, until runs of this sitting say better
POLL_SECONDS = 0.5


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
    scenes: Sequence[Path], settings: Sequence[Setting], out: Path, samples: int = 64
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
    return _run(jobs)


def run_pairs(
    pairs: Sequence[tuple[Path, Setting]],
    out: Path,
    samples: int = 64,
    seconds: float | None = None,
) -> list[Outcome]:
    """Train scenes with settings of their own, one after another.

    out/SCENE/SETTING/ holds the run, what it said (output.txt) and result.json, an `Outcome`. A
    training whose result.json is there already is not done again; one that failed is. A failure is
    an outcome like others, that of a scene that cannot be read too: the rest goes on.

    Args:
        pairs: scenes are told apart by the names of their folders.
        samples: of the light per pixel of relit pictures in evaluation, >= 1.
        seconds: what one may take, a guess for the bar; the configuration's time when left out.

    Raises:
        UserError: a setting that no configuration follows from, a pair that comes twice, or
            results of other settings in `out`.
        OSError: `out` cannot be written.
    """
    _named(dict.fromkeys(data for data, _ in pairs))
    for scene in dict.fromkeys(data for data, _ in pairs):
        _distinct([setting for data, setting in pairs if data == scene])
    return _run([_job(data.resolve(), s, out, samples, seconds) for data, s in pairs])


def _run(jobs: Sequence[Job]) -> list[Outcome]:
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
    with _Bar(missing, len(jobs)) as shown:
        for job in missing:
            done[job.folder] = _train(job, shown)
            shown.finished(job, done[job.folder])
    return [done[job.folder] for job in jobs]


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
    seconds = 60 * config.minutes + EVALUATION_SECONDS if seconds is None else seconds
    return Job(folder, data.name, data, setting, samples, identity(config, samples), seconds)


def _train(job: Job, shown: _Bar) -> Outcome:
    """The outcome of a job, which is recorded in its folder."""
    job.folder.mkdir(parents=True, exist_ok=True)
    (job.folder / RESULT).unlink(missing_ok=True)  # of a failure before
    fields = {"data": str(job.data), "setting": job.setting, "samples": job.samples}
    with replacing(job.folder / worker.JOB) as temporary:
        temporary.write_text(json.dumps(fields, default=dataclasses.asdict), encoding="utf-8")
    with (job.folder / OUTPUT).open("wb") as output:
        command = [sys.executable, "-m", worker.__name__, str(job.folder)]
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT
        )
        begin = time.monotonic()
        try:
            while process.poll() is None:
                shown.now(job, time.monotonic() - begin)
                time.sleep(POLL_SECONDS)
        finally:
            process.kill()  # only when this was interrupted is it still there
            process.wait()
    found = load_outcome(job.folder)
    if found is None:
        error = _reason(process.returncode, job.folder / OUTPUT)
        found = Outcome(job.scene, job.setting.name, job.identity, error=error)
        found.save(job.folder)
    return found


def _reason(code: int, output: Path) -> str:
    """Why a process ended without a result: the signal, or the last line that it said."""
    if code < 0:
        return f"ended by {signal.Signals(-code).name}"
    said = output.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return said[-1] if said else f"ended with exit code {code}"


class _Bar:
    """How far the trainings are, and the time that is left."""

    def __init__(self, jobs: Sequence[Job], total: int) -> None:
        self._left = sum(job.seconds for job in jobs)
        self._spent, self._expected = 0.0, 0.0  # seconds of what was done in this sitting
        self._now = 0.0
        self._progress = bar(
            TextColumn("{task.completed}/{task.total}"),
            BarColumn(),
            TextColumn("{task.description}  {task.fields[left]}"),
            TimeElapsedColumn(),
        )
        self._task = self._progress.add_task("", total=total, completed=total - len(jobs), left="")

    def __enter__(self) -> _Bar:
        self._progress.start()
        return self

    def __exit__(self, *_) -> None:
        self._progress.stop()

    def now(self, job: Job, seconds: float) -> None:
        """A job has run for so many seconds."""
        self._now = seconds
        # How long earlier jobs of this sitting took against what was expected of them
        pace = self._spent / self._expected if self._expected else 1.0
        left = max(pace * self._left - seconds, 0.0)
        self._progress.update(
            self._task,
            description=f"{job.scene}/{job.setting.name}",
            left=f"about {left / 60:.0f} min left",
        )

    def finished(self, job: Job, outcome: Outcome) -> None:
        self._spent, self._expected = self._spent + self._now, self._expected + job.seconds
        self._left -= job.seconds
        self._progress.advance(self._task)
        if outcome.error:
            log.info("%s/%s failed: %s", job.scene, job.setting.name, outcome.error)
