"""The machines that work is done on: this one alone, or a cluster of Dask that is there."""

from __future__ import annotations

import contextlib
import logging
import tempfile
from collections.abc import Iterator
from threading import Lock
from typing import TYPE_CHECKING, Any

from univoxel.errors import MissingExtra, ProcessFailed, UserError

if TYPE_CHECKING:
    from distributed import Client

CONNECT_SECONDS = 15.0  # that a scheduler may take to answer
# Clusters of one process start one by one: Dask changes its settings for all threads, and of what
# two of them import at once one may get half
STARTING = Lock()


def require() -> None:
    """Check that Dask's scheduler is there.

    Raises:
        MissingExtra: it is missing.
    """
    try:
        import distributed  # noqa: F401
    except ImportError:
        raise MissingExtra(
            "many scenes are shared out by Dask, which is missing: pip install 'univoxel[cluster]'"
        ) from None


@contextlib.contextmanager
def machines(jobs: int, scheduler: str | None = None) -> Iterator[Client]:
    """A client of this machine, of so many pieces at once, or of a scheduler.

    This machine's scheduler and worker are threads of this process: they open no port that others
    could reach, and need none, as each piece has processes of its own.

    Args:
        jobs: pieces at once, >= 1; of a scheduler its workers' threads decide.
        scheduler: address of one that is there, such as tcp://10.0.0.1:8786.

    Raises:
        UserError: jobs out of range.
        MissingExtra: Dask is missing.
        ProcessFailed: the scheduler does not answer, or its workers have no univoxel.
    """
    require()
    if jobs < 1:
        raise UserError(f"jobs must be at least 1, got {jobs}", "jobs")
    from distributed import Client

    with contextlib.ExitStack() as stack:
        _hush(stack)
        if scheduler is None:
            client = stack.enter_context(_local(jobs, stack))
        else:
            try:
                client = stack.enter_context(Client(scheduler, timeout=CONNECT_SECONDS))
            except (OSError, ValueError, TypeError) as error:
                said = " ".join(str(error).split()) or type(error).__name__
                raise ProcessFailed(
                    f"scheduler={scheduler}: no scheduler of Dask answers there: {said:.200}",
                    "scheduler",
                ) from None
            _check_workers(client, scheduler)
        yield client


def _local(jobs: int, stack: contextlib.ExitStack) -> Client:
    """A client of a cluster in this process."""
    import dask.config
    from distributed import Client, LocalCluster

    # Its pages would tell others on this machine what runs here
    routes = {"distributed.scheduler.http.routes": [], "distributed.worker.http.routes": []}
    nowhere = "127.0.0.1:0"
    scratch = stack.enter_context(tempfile.TemporaryDirectory(prefix="univoxel-"))
    with STARTING, dask.config.set(routes):
        cluster = LocalCluster(
            n_workers=1,
            threads_per_worker=jobs,
            processes=False,
            memory_limit=0,  # of this process, which does nothing
            silence_logs=logging.CRITICAL,
            dashboard_address=nowhere,
            worker_dashboard_address=nowhere,
            scheduler_kwargs={"dashboard": False},
            local_directory=scratch,
        )
    return Client(stack.enter_context(cluster))


def _check_workers(client: Client, scheduler: str) -> None:
    """Refuse workers that have another univoxel than this, or none.

    Raises:
        ProcessFailed: there are such.
    """
    from univoxel import __version__

    workers: Any = client.run(_version, on_error="return")
    for address, found in workers.items():
        if found != __version__:
            raise ProcessFailed(
                f"scheduler={scheduler}: expected workers with univoxel {__version__}, got "
                f"{found if isinstance(found, str) else 'none'} on {address}",
                "scheduler",
            )


def _version() -> str:
    """The version of univoxel on a worker."""
    import univoxel

    return univoxel.__version__


def _hush(stack: contextlib.ExitStack) -> None:
    """Let Dask's own loggers say nothing: what matters is told in a line."""
    for name in ("distributed", "tornado.application", "asyncio"):
        logger = logging.getLogger(name)
        stack.callback(logger.setLevel, logger.level)
        logger.setLevel(logging.CRITICAL)
