"""A job: its steps as command lines, its record, and how a worker runs it."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from filelock import FileLock, Timeout

from univoxel import guard
from univoxel.errors import DataError, ExistingFile, UserError
from univoxel.files import read_json, replacing

LOCK_SECONDS = 3.0  # until another job is taken up in place of one that others are at work on
POLL_SECONDS = 1.0
RECORD = ("identity", "seconds", "errors")  # earlier versions recorded more
# How many threads numerical libraries may take; Dask sets them to 1 for its workers
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


@dataclass(frozen=True)
class Step:
    """One process of a job."""

    name: str
    arguments: tuple[str | tuple[Path, ...], ...]  # of Python; of paths the first that is there
    makes: Path | None = None  # whole or absent: where it is there the step is done; None: never
    after: Path | None = None  # what it makes must not be older than this file
    unless: tuple[Path, ...] = ()  # where one of these is there the step is done, too
    log: Path | None = None  # of a training
    needed: bool = True  # steps after it make no sense without it

    def done(self) -> bool:
        """Whether there is nothing left to do."""
        if self.makes is None or not self.makes.exists():
            return any(path.exists() for path in self.unless)
        if self.after is None or not self.after.exists():
            return True
        return self.makes.stat().st_mtime_ns >= self.after.stat().st_mtime_ns

    def words(self) -> list[str]:
        """The arguments as they are now; where no path is there, the last."""
        choices = [(a,) if isinstance(a, str) else a for a in self.arguments]
        return [str(next((a for a in c[:-1] if Path(a).exists()), c[-1])) for c in choices]


@dataclass(frozen=True)
class Job:
    """Steps, one after another, that no two processes shall be at work on at once."""

    name: str  # unique
    steps: tuple[Step, ...]
    files: Path  # beginning of its files: .lock, .txt (what processes say) and .json (its record)
    identity: dict[str, Any] = field(default_factory=dict)  # what its results follow from; JSON
    threads: int | None = None  # of its processes; None: its share of a worker's machine

    def file(self, suffix: str) -> Path:
        return self.files.with_name(self.files.name + suffix)

    def record(self) -> dict[str, dict[str, Any]]:
        """What is known from all sittings: identity; seconds, and errors of the last, by step.

        Raises:
            DataError: the file is no record.
        """
        path = self.file(".json")
        found = read_json(path) if path.exists() else {}
        if not isinstance(found, dict) or any(type(found.get(k, {})) is not dict for k in RECORD):
            raise DataError(f"{path}: expected the record of a job: remove it")
        return {key: found.get(key, {}) for key in RECORD}

    def save(self, record: dict[str, dict[str, Any]]) -> None:
        """Write the record, whole or not at all."""
        with replacing(self.file(".json")) as temporary:
            temporary.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")

    def check_same(self) -> None:
        """Refuse to go on with what other options began.

        Raises:
            ExistingFile: they are others.
        """
        before = self.record()["identity"]
        other = [key for key, value in self.identity.items() if before and before.get(key) != value]
        if other:
            where = f"{self.name}: {self.file('.json')} is of another {' and '.join(other)}"
            hint = "choose another out, or remove that file and the folder of its results"
            raise ExistingFile(f"{where}: {hint}", "out")


@dataclass(frozen=True)
class Result:
    """How a sitting of a job ended."""

    name: str
    state: Literal["done", "failed", "killed", "locked"]  # locked: another is at work on it
    errors: dict[str, str] = field(default_factory=dict)  # a line each, by step
    seconds: float = 0.0  # of this sitting


def run_job(job: Job, watch: Callable[[Step], None] = lambda step: None) -> Result:
    """Run the steps that are left of a job. Errors, also of files, are part of the result.

    Args:
        watch: called every second while a step runs; what it raises ends the step.
    """
    begin = time.monotonic()
    try:
        job.files.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(job.file(".lock"), timeout=LOCK_SECONDS):
            state, errors = _steps(job, watch)
    except Timeout:
        state, errors = "locked", {}
    except (OSError, UserError) as error:  # of files beside those of the steps
        state, errors = "failed", {"files": " ".join(str(error).split())}
    return Result(job.name, state, errors, time.monotonic() - begin)


def _steps(job: Job, watch: Callable[[Step], None]) -> tuple[Any, dict[str, str]]:
    """State and errors of a job after the steps that are left, alone with it."""
    seconds, errors = job.record()["seconds"], {}
    record = {"identity": job.identity, "seconds": seconds, "errors": errors}
    job.save(record)
    for step in job.steps:
        if step.done():
            continue
        begin = time.monotonic()
        code, said = _run(job, step, watch)
        seconds[step.name] = seconds.get(step.name, 0.0) + time.monotonic() - begin
        if code < 0:
            name = signal.Signals(-code).name
            errors[step.name] = f"ended by {name}, as the system does where memory is short"
        elif code:
            errors[step.name] = said or f"ended with exit code {code}"
        elif step.makes is not None and not step.makes.exists():
            errors[step.name] = f"ended well and left no {step.makes}"
        job.save(record)
        if code < 0:
            return "killed", errors
        if step.name in errors and step.needed:
            break
    return "failed" if errors else "done", errors


def _run(job: Job, step: Step, watch: Callable[[Step], None]) -> tuple[int, str]:
    """Exit code of the process of a step, of a signal its number below 0; the last line it said."""
    command = [sys.executable, *step.words()]
    limits = {name: str(job.threads) for name in THREADS if job.threads is not None}
    with job.file(".txt").open("ab+") as output:
        output.write(f"\n{time.strftime('%F %T')}: {' '.join(command)}\n".encode())
        output.flush()
        place = output.tell()
        process = subprocess.Popen(
            [sys.executable, "-m", guard.__name__, str(os.getpid()), *command],
            **{"stdin": subprocess.DEVNULL, "stdout": output, "stderr": subprocess.STDOUT},
            env=os.environ | limits,
            start_new_session=True,  # Ctrl-C is for who waits for it
        )
        try:
            while process.poll() is None:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(POLL_SECONDS)
                watch(step)
        finally:
            process.kill()  # only where this was broken off is it still there
            process.wait()
        output.seek(place)
        said = output.read().decode("utf-8", "replace").strip().splitlines()
    return process.returncode, said[-1].strip() if said else ""


def last_line(log: Path | None) -> dict[str, Any]:
    """What the last line of a training's log says; nothing where it cannot be read."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        line = json.loads(log.read_bytes().splitlines()[-1]) if log else {}
        return line if isinstance(line, dict) else {}
    return {}
