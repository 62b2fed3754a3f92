"""Schedulers and workers of a cluster as processes of their own, as people start them."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

POLL_SECONDS = 0.02


def wait_for(what: Callable[[], object], seconds: float = 60.0) -> None:
    """Wait until something is so; time in which this process is stopped does not count."""
    for _ in range(round(seconds / POLL_SECONDS)):
        if what():
            return
        time.sleep(POLL_SECONDS)
    raise AssertionError("waited in vain")


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@contextlib.contextmanager
def process(*arguments: str, **options):
    """A process of ours, which is ended."""
    running = subprocess.Popen([sys.executable, *arguments], **options)
    try:
        yield running
    finally:
        running.kill()
        running.wait()


@contextlib.contextmanager
def scheduler(folder: Path, port: int = 0):
    """A scheduler; its process and address."""
    file = folder / f"scheduler-{time.monotonic_ns()}.json"
    options = ["--host", "127.0.0.1", "--port", str(port), "--no-dashboard", "--no-show"]
    options += ["--dashboard-address", "127.0.0.1:0", "--scheduler-file", str(file)]
    with process("-m", "distributed.cli.dask_scheduler", *options, stderr=-3) as running:
        wait_for(lambda: file.exists() and file.read_text().rstrip().endswith("}"))
        yield running, json.loads(file.read_text())["address"]


def worker(address: str):
    options = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--host", "127.0.0.1"]
    return process("-m", "distributed.cli.dask_worker", address, *options, stderr=-3)
