"""Jobs on workers of Dask: those of this machine alone, or of a cluster that is there."""

from __future__ import annotations

import contextlib
import logging
import tempfile
import time
import uuid
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import timedelta
from threading import Lock
from typing import TYPE_CHECKING, Any

from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from univoxel import __version__
from univoxel.bars import bar
from univoxel.errors import MissingExtra, ProcessFailed, UserError
from univoxel.jobs.job import Job, Result, Step, last_line, run_job
from univoxel.machine import cores

if TYPE_CHECKING:
    from distributed import Client

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
            "many scenes are shared out by Dask, which is missing: pip install 'univoxel[cluster]'"
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
            said = f"no scheduler of Dask answers there: {' '.join(str(error).split()):.200}"
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
                    errors = {s: f"{said}; tries: {tries}" for s, said in result.errors.items()}
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
        raise ProcessFailed("the scheduler is gone: the same command goes on")
    error = future.exception()
    if error is None:
        return future.result()
    if isinstance(error, KilledWorker):
        return Result(job.name, "failed", {"worker": "every worker that took it died"})
    raise ProcessFailed(f"a worker has another univoxel than this, or none: {error}") from error


class ProgressTable:
    """A bar of all jobs beside those at work; without a terminal a line now and then."""

    def __init__(self, before: int, total: int) -> None:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[facts]}"),
        )
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
        row = {
            "completed": self._before + made,
            "description": f"{self._before + ended}/{self._total}",
        }
        shown = separator.join([*facts, *(text for _, text in told)])
        self.progress.update(self._all, facts=shown, **row)
