"""What a worker does with a job: its steps, in processes that end with the worker."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from univoxel import guard
from univoxel.errors import UserError
from univoxel.jobs.job import Job, Result, Step
from univoxel.machine import cores

LOCK_SECONDS = 3.0  # until another job is taken up in place of one that others are at work on
POLL_SECONDS = 1.0
# How many threads numerical libraries may take; Dask sets them to 1 for its workers
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


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


def run_on_worker(job: Job, topic: str) -> Result:
    """`run_job` as a task of Dask, which tells under a topic, and ends when nobody waits for it."""
    from distributed import Reschedule, Status, get_worker

    worker = get_worker()
    key = worker.get_current_task()
    over = (Status.closing, Status.closed, Status.stopping, Status.failed)

    def watch(step: Step) -> None:
        task = worker.state.tasks.get(key)
        if worker.status in over or task is None or task.state == "cancelled":
            raise Reschedule
        worker.log_event(topic, last_line(step.log) | {"job": job.name, "process": step.name})

    threads = job.threads or max(1, int(cores()) // worker.state.nthreads)
    return run_job(dataclasses.replace(job, threads=threads), watch)


def _steps(job: Job, watch: Callable[[Step], None]) -> tuple[Any, dict[str, str]]:
    """State and errors of a job after the steps that are left, alone with it."""
    record = dataclasses.replace(job.record(), identity=job.identity, errors={})
    seconds, errors = record.seconds, record.errors
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
