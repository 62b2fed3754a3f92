"""The work on a piece, as a worker does it: its steps in processes that end with the worker."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from univoxel import child
from univoxel.cluster.piece import Ended, Piece, Record, Step, Told, load_record
from univoxel.errors import UserError
from univoxel.machine import cores

POLL_SECONDS = 0.25
TELL_SECONDS = 2.0
TAIL = 4096  # bytes at the end of a log that hold its last line
# How many threads numerical libraries may take; Dask sets them to 1 for its workers
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


class Unwanted(Exception):
    """Nobody waits for the work any more; its process was ended."""


def work(piece: Piece, tell: Callable[[Told], None], wanted: Callable[[], bool]) -> Ended:
    """Do the steps that are left of a piece.

    What a step makes decides whether it is done, so that a later call goes on. Errors of a step,
    also of files that cannot be written, are part of what is returned.

    Args:
        tell: called every few seconds.
        wanted: asked several times a second; where it says no, the process is ended.

    Raises:
        Unwanted: it said no.
    """
    begin, where = time.monotonic(), platform.node()
    try:
        piece.lock.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(piece.lock, timeout=0):
            state, errors = _steps(piece, tell, wanted, where)
    except Timeout:
        state, errors = "taken", {}
    except (OSError, UserError) as error:  # of files beside those of the steps
        state, errors = "failed", {"files": " ".join(str(error).split())}
    return Ended(piece.name, state, errors, time.monotonic() - begin, where)


def on_worker(piece: Piece, topic: str) -> Ended:
    """`work` as a task of Dask, which tells under a topic and ends when the task is dropped."""
    from distributed import Status, get_worker

    worker = get_worker()
    key = worker.get_current_task()
    over = (Status.closing, Status.closed, Status.stopping, Status.failed)

    def tell(told: Told) -> None:
        worker.log_event(topic, dataclasses.asdict(told))

    def wanted() -> bool:
        task = worker.state.tasks.get(key)
        return worker.status not in over and task is not None and task.state != "cancelled"

    if piece.threads is None:
        threads = max(1, int(cores()) // worker.state.nthreads)
        piece = dataclasses.replace(piece, threads=threads)
    return work(piece, tell, wanted)


def _steps(
    piece: Piece, tell: Callable[[Told], None], wanted: Callable[[], bool], where: str
) -> tuple[Any, dict[str, str]]:
    """State and errors of a piece after the steps that are left, alone with it."""
    record = dataclasses.replace(load_record(piece.record), where=where, identity=piece.identity)
    errors: dict[str, str] = {}
    for step in piece.steps:
        if step.done():
            continue
        begin = time.monotonic()
        code, said = _run(piece, step, tell, wanted)
        if code == child.LOCKED:
            return "taken", {}
        seconds = record.seconds.get(step.name, 0.0) + time.monotonic() - begin
        record = dataclasses.replace(record, seconds=record.seconds | {step.name: seconds})
        if code < 0:
            errors[step.name] = f"ended by {signal.Signals(-code).name}"
            _save(dataclasses.replace(record, errors=errors), piece)
            return "died", errors
        if code:
            errors[step.name] = said or f"ended with exit code {code}"
        elif step.makes is not None and not step.makes.exists():
            errors[step.name] = f"ended well and left no {step.makes}"
        _save(dataclasses.replace(record, errors=errors), piece)
        if step.name in errors and step.needed:
            break
    _save(dataclasses.replace(record, errors=errors), piece)
    return "failed" if errors else "done", errors


def _save(record: Record, piece: Piece) -> None:
    if piece.record is not None and record != load_record(piece.record):
        record.save(piece.record)


def _run(
    piece: Piece, step: Step, tell: Callable[[Told], None], wanted: Callable[[], bool]
) -> tuple[int, str]:
    """Exit code of the process of a step, of a signal its number below 0; the last line it said."""
    prefix = [sys.executable, "-m", child.__name__, str(os.getpid()), f"{piece.lock}.child"]
    command = [*prefix, sys.executable, *map(str, step.arguments)]
    limits = {name: str(piece.threads) for name in THREADS if piece.threads is not None}
    begin, told = time.monotonic(), 0.0
    with piece.output.open("ab") as output:
        words = " ".join(command[len(prefix) :])
        output.write(f"\n{time.strftime('%F %T')} {platform.node()}: {words}\n".encode())
        output.flush()
        place = output.tell()
        process = subprocess.Popen(
            command,
            **{"stdin": subprocess.DEVNULL, "stdout": output, "stderr": subprocess.STDOUT},
            env=os.environ | limits,
            start_new_session=True,  # Ctrl-C is for who waits for it
        )
        try:
            while process.poll() is None:
                if not wanted():
                    raise Unwanted(piece.name)
                spent = time.monotonic() - begin
                if spent >= told:
                    told = spent + TELL_SECONDS
                    tell(_told(piece, step, spent))
                time.sleep(POLL_SECONDS)
        finally:
            process.kill()  # only where this was broken off is it still there
            process.wait()
    return process.returncode, _last_words(piece.output, place)


def _told(piece: Piece, step: Step, seconds: float) -> Told:
    """How far a step is; what its log does not say is None."""
    line = last_line(step.log) if step.log else {}
    names = ("share", "rays_per_second", "held_out_psnr")
    return Told(piece.name, step.name, seconds, **{name: line.get(name) for name in names})


def last_line(path: Path) -> dict[str, Any]:
    """What the last line of a training's log says; nothing where it cannot be read."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        with path.open("rb") as file:
            file.seek(max(path.stat().st_size - TAIL, 0))
            line = json.loads(file.read().splitlines()[-1])
        return line if isinstance(line, dict) else {}
    return {}


def _last_words(output: Path, place: int) -> str:
    """The last line after a place in a file; empty where there is none."""
    with output.open("rb") as file:
        file.seek(place)
        said = file.read().decode("utf-8", "replace").strip().splitlines()
    return said[-1].strip() if said else ""
