"""The machine: processor, cores, memory. None if the system does not tell."""

from __future__ import annotations

import contextlib
import os
import platform
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from univoxel.core import system

ROOT = Path("/")


@dataclass(frozen=True)
class Memory:
    """What this process may have, bytes: the machine's, or less where a control group limits it."""

    total: int
    free: int | None  # of it, with what the system would give back at once


def processor(root: Path = ROOT) -> str:
    """Name of the processor."""
    for line in _lines(root / "proc/cpuinfo"):
        name, _, value = line.partition(":")
        if name.strip() == "model name":
            return value.strip()
    return platform.processor() or platform.machine()


def cores(root: Path = ROOT) -> float:
    """Cores that this process may use; a control group may grant parts of one."""
    granted = [float(system.usable_cores())]
    for group in _groups("cpu", root):
        limit = _lines(group / "cpu.max") or [
            f"{quota} {period}"
            for quota in _lines(group / "cpu.cfs_quota_us")
            for period in _lines(group / "cpu.cfs_period_us")
        ]
        for quota, period in (line.split() for line in limit):
            if quota not in ("max", "-1"):
                granted.append(int(quota) / int(period))
    return min(granted)


def threads_asked() -> int | None:
    """Threads that the environment asks for, as `--threads` does; None: it does not."""
    asked = os.environ.get("OMP_NUM_THREADS", "").strip()
    return int(asked) if asked.isdigit() and int(asked) else None


def memory(root: Path = ROOT) -> Memory | None:
    """Memory that this process may have."""
    told = {}
    for line in _lines(root / "proc/meminfo"):
        name, _, value = line.partition(":")
        told[name] = int(value.split()[0]) * 1024
    if "MemTotal" in told:
        total, free = told["MemTotal"], told.get("MemAvailable")
    else:
        known = system.memory()
        if known is None:
            return None
        total, free = known
    machine = total
    for group in _groups("memory", root):
        limit = _number(group / "memory.max", group / "memory.limit_in_bytes")
        used = _number(group / "memory.current", group / "memory.usage_in_bytes")
        if limit is None or used is None or limit >= machine:
            continue
        # Pages of files that nobody has read for a while are given back when memory is short
        kept = [line.split() for line in _lines(group / "memory.stat")]
        given_back = {name: int(value) for name, value in kept}.get("inactive_file", 0)
        left = max(limit - used + given_back, 0)
        total, free = min(total, limit), left if free is None else min(free, left)
    return Memory(total, free)


def _groups(controller: str, root: Path) -> Iterator[Path]:
    """Folders of the control groups of this process, the innermost first.

    Source: Linux, "Control Group v2" and "Control Groups version 1". Inside a container the path
    may be one that is only seen from outside: the mounted root then is the container's own group.
    """
    for line in _lines(root / "proc/self/cgroup"):
        _, controllers, path = line.split(":", 2)
        if controllers and controller not in controllers.split(","):
            continue
        top = root / "sys/fs/cgroup" / (controller if controllers else "")
        inner = Path(path.lstrip("/"))
        if ".." not in inner.parts:
            yield from (top / p for p in (inner, *inner.parents) if p != Path("."))
        yield top


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except OSError:
        return []


def _number(*paths: Path) -> int | None:
    """The number in the first of these files that holds one."""
    for path in paths:
        for line in _lines(path):
            with contextlib.suppress(ValueError):
                return int(line)
    return None
