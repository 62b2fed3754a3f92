"""Jobs: steps as command lines, their records, and the Dask workers that run them."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import subprocess
import sys
import tempfile
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import timedelta
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, Literal

from filelock import FileLock, Timeout
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from univoxel import __version__
from univoxel.core import guard, system
from univoxel.core.files import read_json, write_json
from univoxel.core.machine import cores
from univoxel.core.progress_bar import bar
from univoxel.errors import DataError, ExistingFile, MissingExtra, ProcessFailed, UserError

if TYPE_CHECKING:
    from distributed import Client

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
        """What is known from all sittings: identity; seconds, and errors of the last, by step; a
        DataError where the file is no record."""
        path = self.file(".json")
        found = read_json(path) if path.exists() else {}
        if not isinstance(found, dict) or any(type(found.get(k, {})) is not dict for k in RECORD):
            raise DataError(f"{path}: expected the record of a batch job: remove this file")
        return {key: found.get(key, {}) for key in RECORD}

    def save(self, record: dict[str, dict[str, Any]]) -> None:
        """Write the record, whole or not at all."""
        write_json(self.file(".json"), record)

    def check_same(self) -> None:
        """Refuse, by an ExistingFile, to continue with what other options began."""
        before = self.record()["identity"]
        other = [key for key, value in self.identity.items() if before and before.get(key) != value]
        if other:
            where = f"{self.name}: {self.file('.json')} has other values of {' and '.join(other)}"
            hint = "choose another folder for out, or remove that file and the scene's results"
            raise ExistingFile(f"{where} than this call: {hint}", "out")


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
        if (cause := system.ended_by(code)) is not None:
            errors[step.name] = f"ended by {cause}; SIGKILL often means that memory runs out"
        elif code:
            errors[step.name] = said or f"ended with exit code {code}"
        elif step.makes is not None and not step.makes.exists():
            errors[step.name] = f"ended without an error, but {step.makes} is missing"
        job.save(record)
        if cause is not None:
            return "killed", errors
        if step.name in errors and step.needed:
            break
    return "failed" if errors else "done", errors


def _run(job: Job, step: Step, watch: Callable[[Step], None]) -> tuple[int, str]:
    """Exit code of the process of a step, of a signal its number below 0; the last line it said."""
    words = step.words()
    limits = {name: str(job.threads) for name in THREADS if job.threads is not None}
    with job.file(".txt").open("ab+") as output:
        output.write(f"\n{time.strftime('%F %T')}: {' '.join([sys.executable, *words])}\n".encode())
        output.flush()
        place = output.tell()
        # In a session of its own: Ctrl-C is for who waits for it
        options = {"env": os.environ | limits, **system.own_session()}
        with guard.guarded(words, output, **options) as process:
            while process.poll() is None:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(POLL_SECONDS)
                watch(step)
        output.seek(place)
        return process.returncode, guard.last_words(output.read())


def last_line(log: Path | None) -> dict[str, Any]:
    """What the last line of a training's log says; nothing where it cannot be read."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        line = json.loads(log.read_bytes().splitlines()[-1]) if log else {}
        return line if isinstance(line, dict) else {}
    return {}


# Jobs on workers of Dask: those of this machine only, or of a cluster that is there.


TICK_SECONDS = 0.25
CONNECT_SECONDS = 15.0  # that a scheduler may take to answer
# Dask changes its settings for all threads, and of what two of them import one may get half
STARTING = Lock()


@contextlib.contextmanager
def connect(jobs: int, scheduler: str | None = None) -> Iterator[Client]:
    """A client of this machine, of so many jobs at once (>= 1), or of a scheduler at an address.

    This machine's scheduler and worker are threads of this process: they open no port that others
    could reach, and need none, as each job has processes of its own.

    Raises:
        UserError: jobs out of range.
        MissingExtra: Dask is missing.
        ProcessFailed: the scheduler does not answer, or its workers have another univoxel.
    """
    if jobs < 1:
        raise UserError(f"jobs must be at least 1, got {jobs}", "jobs")
    try:
        from distributed import Client
    except ImportError:
        raise MissingExtra(
            "processing many scenes needs Dask: pip install 'univoxel[cluster]'"
        ) from None
    with contextlib.ExitStack() as stack:
        for name in ("distributed", "tornado.application", "asyncio"):  # what matters is told here
            logger = logging.getLogger(name)
            stack.callback(logger.setLevel, logger.level)
            logger.setLevel(logging.CRITICAL)
        if scheduler is None:
            yield stack.enter_context(Client(_cluster(jobs, stack)))
            return
        try:
            client = stack.enter_context(Client(scheduler, timeout=CONNECT_SECONDS))
        except (OSError, ValueError, TypeError) as error:
            said = f"no Dask scheduler answers at this address: {' '.join(str(error).split()):.200}"
            raise ProcessFailed(f"scheduler={scheduler}: {said}", "scheduler") from None

        def version() -> str:  # in here, so that it goes there by value: its module may lack there
            import univoxel

            return univoxel.__version__

        versions: Any = client.run(version, on_error="return")
        for address, found in versions.items():
            if found != __version__:
                got = f"{found if isinstance(found, str) else 'none'} on {address}"
                said = f"expected workers with univoxel {__version__}, got {got}"
                raise ProcessFailed(f"scheduler={scheduler}: {said}", "scheduler")
        yield client


def _cluster(jobs: int, stack: contextlib.ExitStack) -> Any:
    """A cluster of Dask in this process."""
    import dask.config
    from distributed import LocalCluster

    options: dict[str, Any] = {"processes": False, "memory_limit": 0}  # this process does nothing
    options |= {"dashboard_address": "127.0.0.1:0", "worker_dashboard_address": "127.0.0.1:0"}
    options |= {"scheduler_kwargs": {"dashboard": False}, "silence_logs": logging.CRITICAL}
    options |= {"local_directory": stack.enter_context(tempfile.TemporaryDirectory("univoxel"))}
    # Its pages would tell others on this machine what runs here
    routes = {"distributed.scheduler.http.routes": [], "distributed.worker.http.routes": []}
    with STARTING, dask.config.set(routes):
        cluster = LocalCluster(n_workers=1, threads_per_worker=jobs, **options)
    return stack.enter_context(cluster)


def run_jobs(client: Client, jobs: Sequence[Job], total: int, tries: int = 3) -> Iterator[Result]:
    """Let workers run jobs; give the result of each as it ends, done or failed.

    Args:
        total: jobs with those that were done before, for the bar.
        tries: how often a job whose process is killed is run until it counts as failed, >= 1.

    Raises:
        ProcessFailed: the scheduler is gone, or a worker cannot run jobs.
    """
    topic, deaths = f"univoxel-{uuid.uuid4().hex}", Counter[str]()
    table = ProgressTable(total - len(jobs), total)
    client.subscribe_topic(topic, lambda event: table.tell(**event[1]))

    def submit(job: Job) -> Any:
        return client.submit(run_on_worker, job, topic, pure=False)

    with table.progress:
        running = {submit(job): job for job in jobs}
        while running:
            time.sleep(TICK_SECONDS)
            table.refresh()
            for future in [f for f in running if f.done() or f.status == "lost"]:
                job = running.pop(future)
                result = _result(future, job)
                deaths[job.name] += result.state == "killed"
                if deaths[job.name] >= tries:
                    errors = {s: f"{said}; attempts: {tries}" for s, said in result.errors.items()}
                    result = replace(result, state="failed", errors=errors)
                table.ended(result)
                if result.state in ("killed", "locked"):
                    running[submit(job)] = job
                else:
                    yield result


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
        line = last_line(step.log)
        told = {name: line.get(name) for name in ("share", "held_out_psnr")}
        worker.log_event(topic, {"job": job.name, "step": step.name, **told})

    threads = job.threads or max(1, int(cores()) // worker.state.nthreads)
    return run_job(replace(job, threads=threads), watch)


def _result(future: Any, job: Job) -> Result:
    """What a task returned, or what its end says."""
    from distributed import KilledWorker

    if future.status in ("lost", "cancelled"):
        raise ProcessFailed("lost the connection to the scheduler: run the command again to resume")
    error = future.exception()
    if error is None:
        return future.result()
    if isinstance(error, KilledWorker):
        return Result(job.name, "failed", {"worker": "every worker that ran this scene was killed"})
    raise ProcessFailed(f"a worker has another version of univoxel, or none: {error}") from error


class ProgressTable:
    """A bar of all jobs beside those at work; without a terminal a line now and then."""

    def __init__(self, before: int, total: int) -> None:
        columns = TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[facts]}")
        self.progress: Progress = bar(*columns, TimeElapsedColumn())
        self._all = self.progress.add_task(f"{before}/{total}", total=total, facts="")
        self._begin, self._before, self._total = time.monotonic(), before, total
        self._ended = Counter[str]()  # by state
        self._told: dict[str, tuple[float, str]] = {}  # share of a job's step, and what to show

    def tell(
        self, job: str, step: str, share: float | None, held_out_psnr: float | None, **_: Any
    ) -> None:
        """Take in how far a job is. Dask calls it, in a thread of its own."""
        facts = "" if share is None else f" {share:.0%}"
        facts += "" if held_out_psnr is None else f" {held_out_psnr:.1f} dB"
        self._told[job] = share or 0.0, f"{job} {step}{facts}"

    def ended(self, result: Result) -> None:
        """Take in how a sitting of a job ended."""
        self._told.pop(result.name, None)
        self._ended[result.state] += 1

    def refresh(self) -> None:
        """Show it."""
        told, ended = list(self._told.values()), self._ended["done"] + self._ended["failed"]
        made = ended + sum(share for share, _ in told)
        facts = [f"{self._ended['failed']} failed"] if self._ended["failed"] else []
        if ended:
            spent, left = time.monotonic() - self._begin, self._total - self._before - made
            facts.append(f"about {timedelta(seconds=round(spent * left / made))} left")
        separator = "\n" if self.progress.console.is_terminal else "  "
        shown = separator.join([*facts, *(text for _, text in told)])
        description = f"{self._before + ended}/{self._total}"
        completed = self._before + made
        self.progress.update(self._all, completed=completed, description=description, facts=shown)
