"""What is installed around the package: builds of torch, OpenMP runtimes, optional extras."""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib import metadata

import torch
from threadpoolctl import threadpool_info

DEVELOPERS = {"bench", "dev", "docs", "wheel"}  # extras that no command asks for


@dataclass(frozen=True)
class Extra:
    """An optional set of packages."""

    name: str
    missing: tuple[str, ...]  # packages; none: the extra is there


def openmp_runtimes() -> list[str]:
    """Files of the OpenMP runtimes that this process has loaded."""
    found = {p["filepath"] for p in threadpool_info() if p["user_api"] == "openmp"}
    return sorted(found)


def torch_build() -> str:
    """Version of torch, and what it was built for."""
    for what, version in (("CUDA", torch.version.cuda), ("ROCm", torch.version.hip)):
        if version:
            return f"{torch.__version__}, built for {what} {version}"
    return f"{torch.__version__}, built for CPUs"


def extras(distribution: str = "univoxel") -> list[Extra] | None:
    """The extras for users, with what is missing of each; None where nothing is installed."""
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
        if not is_installed(package[0]):
            lacks.append(package[0])
    return [Extra(name, tuple(lacks)) for name, lacks in sorted(missing.items())]


def is_installed(package: str) -> bool:
    """Whether a distribution is there, of any version."""
    try:
        metadata.version(package)
    except metadata.PackageNotFoundError:
        return False
    return True
