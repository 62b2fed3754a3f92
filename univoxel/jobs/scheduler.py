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
from threading import Lock
from typing import TYPE_CHECKING, Any

from univoxel import __version__
from univoxel.errors import MissingExtra, ProcessFailed, UserError
from univoxel.jobs.job import Job, Result
from univoxel.jobs.progress import ProgressTable
from univoxel.jobs.worker import run_on_worker

if TYPE_CHECKING:
    from distributed import Client

TICK_SECONDS = 0.25
CONNECT_SECONDS = 15.0  # that a scheduler may take to answer
# Clusters of one process start one by one: Dask changes its settings for all threads, and of what
# two of them import at once one may get half
STARTING = Lock()


@contextlib.contextmanager
def connect(jobs: int, scheduler: str | None = None) -> Iterator[Client]:
    """A client of this machine, of so many jobs at once, or of a scheduler.

    This machine's scheduler and worker are threads of this process: they open no port that others
    could reach, and need none, as each job has processes of its own.

    Args:
        jobs: at once, >= 1; of a scheduler its workers' threads decide.
        scheduler: address of one that is there, such as tcp://10.0.0.1:8786.

    Raises:
        UserError: jobs out of range.
        MissingExtra: Dask is missing.
        ProcessFailed: the scheduler does not answer, or its workers have no univoxel.
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
            said = " ".join(str(error).split()) or type(error).__name__
            raise ProcessFailed(
                f"scheduler={scheduler}: no scheduler of Dask answers there: {said:.200}",
                "scheduler",
            ) from None
        versions: Any = client.run(lambda: __import__("univoxel").__version__, on_error="return")
        for address, found in versions.items():
            if found != __version__:
                got = found if isinstance(found, str) else "none"
                raise ProcessFailed(
                    f"scheduler={scheduler}: expected workers with univoxel {__version__}, got "
                    f"{got} on {address}",
                    "scheduler",
                )
        yield client


def _cluster(jobs: int, stack: contextlib.ExitStack) -> Any:
    """A cluster of Dask in this process."""
    import dask.config
    from distributed import LocalCluster

    # Its pages would tell others on this machine what runs here
    routes = {"distributed.scheduler.http.routes": [], "distributed.worker.http.routes": []}
    local: dict[str, Any] = {
        "dashboard_address": "127.0.0.1:0",
        "worker_dashboard_address": "127.0.0.1:0",
    }
    local |= {"local_directory": stack.enter_context(tempfile.TemporaryDirectory("univoxel"))}
    with STARTING, dask.config.set(routes):
        cluster = LocalCluster(
            n_workers=1,
            threads_per_worker=jobs,
            processes=False,
            memory_limit=0,  # of this process, which does nothing
            silence_logs=logging.CRITICAL,
            scheduler_kwargs={"dashboard": False},
            **local,
        )
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
    client.subscribe_topic(topic, lambda event: table.tell(event[1]))

    def submit(job: Job) -> Any:
        return client.submit(run_on_worker, job, topic, pure=False)

    with table.progress:
        running = {submit(job): job for job in jobs}
        while running:
            time.sleep(TICK_SECONDS)
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
