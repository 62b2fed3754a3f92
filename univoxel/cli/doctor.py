"""Checks of the installation and the machine, with remedies."""

from __future__ import annotations

import os
import platform
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

from univoxel import __version__
from univoxel.cli.parsing import STDOUT, JsonFile, json_file, takes
from univoxel.core import machine
from univoxel.core.files import write_json
from univoxel.errors import MissingNative

if TYPE_CHECKING:
    from rich.table import Table

    from univoxel.ops import NativeStatus

State: TypeAlias = Literal["good", "look", "bad"]  # bad: training is refused
COLORS: dict[State, str] = {"good": "green", "look": "yellow", "bad": "red"}
REBUILD = "rebuild univoxel with a compiler, GLM and Embree (pip install . in its source folder)"
DEVELOPERS = {"bench", "dev", "docs", "wheel"}  # extras that no command asks for
ENOUGH = 4 << 30  # bytes: presets on 100 photographs of about 1000 pixels stay below


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at."""

    what: str
    found: str
    state: State = "good"
    remedy: str = ""  # what to do, where there is something to do


@dataclass(frozen=True)
class DoctorOptions:
    json: JsonFile = None
    """write the findings to a file as JSON; use - to print them instead of the table"""


@takes(DoctorOptions)
def command(asked: DoctorOptions) -> None:
    """Check this installation and this machine.

    Checks the processor and its kernels, Embree, PyTorch, OpenMP, threads, memory and optional
    packages. If training is not possible, the exit code is 2.
    """
    import rich

    findings = look()
    with json_file(asked.json) as file:
        if file is not None:
            write_json(file, [asdict(f) for f in findings])
    if asked.json != STDOUT:
        rich.print(table(findings))
    check(findings)


def look() -> list[Finding]:
    """What was found of the installation and the machine."""
    import torch
    from threadpoolctl import threadpool_info

    from univoxel.ops import native_status

    runtimes = {p["filepath"] for p in threadpool_info() if p["user_api"] == "openmp"}
    status = native_status()
    return [
        Finding("univoxel", f"{__version__}, {Path(__file__).parent.parent}"),
        Finding("Python", f"{platform.python_version()}, {platform.platform()}"),
        Finding("processor", f"{machine.processor()}, supports {status.usable[-1]}"),
        kernels(status),
        embree(status),
        Finding("torch", torch_build()),
        openmp(sorted(runtimes)),
        threads(torch.get_num_threads(), machine.cores()),
        memory(machine.memory()),
        *extra_findings(),
    ]


def kernels(status: NativeStatus) -> Finding:
    """Whether the compiled extension is loaded, and the best build of it."""
    if status.variant is None:
        return Finding("kernels", f"not loaded: {status.reason}", "bad", REBUILD)
    found = f"{status.variant}, chosen from {' '.join(status.built)}"
    if status.variant == status.usable[-1]:
        return Finding("kernels", found)
    faster = f"this processor supports {status.usable[-1]}, but there is no build for it: {REBUILD}"
    return Finding("kernels", found, "look", faster)


def embree(status: NativeStatus) -> Finding:
    """Whether rays can be traced."""
    if status.embree is not None:
        return Finding("Embree", f"{status.embree}")
    return Finding("Embree", "missing, but training and relighting need it", "bad", REBUILD)


def openmp(runtimes: Sequence[str]) -> Finding:
    """Whether torch and the kernels share one OpenMP runtime; two would fight over the cores."""
    found = ", ".join(runtimes) or "none"
    if len(runtimes) <= 1:
        return Finding("OpenMP", found)
    remedy = "several OpenMP runtimes slow each other down: import univoxel before other packages"
    return Finding("OpenMP", found, "look", remedy)


def threads(count: int, cores: float) -> Finding:
    """Whether kernels run on as many threads as there are cores to be had."""
    asked = os.environ.get("OMP_NUM_THREADS")
    found = f"{count} on {cores:g} cores" + (f", OMP_NUM_THREADS={asked}" if asked else "")
    if count > max(cores, 1):
        remedy = f"fewer threads are faster: set OMP_NUM_THREADS={max(int(cores), 1)}"
        return Finding("threads", found, "look", remedy)
    return Finding("threads", found)


def memory(found: machine.Memory | None) -> Finding:
    """Whether there is memory enough for a training."""
    if found is None:
        return Finding("memory", "unknown")
    total = f"{found.total / 2**30:.1f} GiB"
    if found.free is None:
        return Finding("memory", total)
    said = f"{found.free / 2**30:.1f} GiB free of {total}"
    if found.free < ENOUGH:
        return Finding("memory", said, "look", "use a larger --downscale, or close other programs")
    return Finding("memory", said)


def extra_findings() -> list[Finding]:
    """A finding for each extra."""
    known = extras()
    if known is None:
        return [Finding("extras", "unknown, because univoxel is importable but not installed")]
    found = []
    for name, missing in known.items():
        finding = Finding(f"extra {name}", "installed")
        if missing:
            remedy = f'if you need this extra: pip install "univoxel[{name}]"'
            finding = Finding(finding.what, f"not installed: {', '.join(missing)}", "look", remedy)
        found.append(finding)
    return found


def table(findings: Sequence[Finding]) -> Table:
    """The findings as the command prints them, what to do under each."""
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for f in findings:
        said = Text(f.found, COLORS[f.state])
        table.add_row(f.what, said.append(f"\n-> {f.remedy}", "default") if f.remedy else said)
    return table


def check(findings: Sequence[Finding]) -> None:
    """Raise a MissingNative, which names what is missing, where training would be refused."""
    bad = [f"{f.what}: {f.found}" for f in findings if f.state == "bad"]
    if bad:
        raise MissingNative(f"this installation cannot train: {'; '.join(bad)}")


def torch_build() -> str:
    """Version of torch, and what it was built for."""
    import torch

    for what, version in (("CUDA", torch.version.cuda), ("ROCm", torch.version.hip)):
        if version:
            return f"{torch.__version__}, built for {what} {version}"
    return f"{torch.__version__}, built for CPUs"


def extras(distribution: str = "univoxel") -> dict[str, list[str]] | None:
    """Packages that are missing of each extra for users; None if nothing is installed."""
    try:
        requirements = metadata.requires(distribution) or []
    except metadata.PackageNotFoundError:
        return None
    missing: dict[str, list[str]] = {}
    for requirement in requirements:
        belongs = re.search(r"""extra\s*==\s*["']([\w.-]+)["']""", requirement)
        package = re.match(r"[\w.-]+", requirement)
        if not belongs or not package or belongs[1] in DEVELOPERS:
            continue
        lacks = missing.setdefault(belongs[1], [])
        try:
            metadata.version(package[0])
        except metadata.PackageNotFoundError:
            lacks.append(package[0])
    return dict(sorted(missing.items()))
