"""Scenes of a batch by name, and how many run at once."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Sequence
from pathlib import Path

from univoxel.config import TrainConfig
from univoxel.data.images import image_size
from univoxel.data.shots import LARGE
from univoxel.errors import UserError
from univoxel.machine import Memory
from univoxel.training.memory import needed_for

MEASURED = "measures.json"  # in the folder of a scene
LOGS = "logs"  # the folder in a batch's of what processes said, records and locks
PICTURES = {".png", ".jpg", ".jpeg", ".exr"}
PER_PROCESS = 600_000_000  # bytes: Python, torch and what is loaded around them
PER_PIXEL = 7  # bytes of a photograph and its alpha


def named(scenes: Sequence[Path]) -> dict[str, Path]:
    """Absolute paths of scenes by the names of their folders.

    Raises:
        UserError: none, two of one name, one that is not there, or one of a name that is taken.
    """
    found: dict[str, Path] = {}
    for path in (scene.resolve() for scene in scenes):
        name = path.stem if path.is_file() else path.name
        if not path.exists():
            raise UserError(f"{path}: expected a scene, got nothing there")
        if name == LOGS or name.startswith("."):
            raise UserError(f"{path}: expected another name than {name!r}: rename the folder")
        if name in found:
            both = f"{found[name]} and {path}"
            raise UserError(f"expected scenes in folders of different names, got {both}")
        found[name] = path
    if not found:
        raise UserError("expected a scene, a folder of photographs, or more; got none")
    return found


def share(
    scenes: Collection[Path],
    config: TrainConfig,
    cores: float,
    memory: Memory | None,
    jobs: int | None = None,
    threads: int | None = None,
) -> tuple[int, int]:
    """Scenes at once, and threads of each, as cores and memory of a machine allow.

    Threads of one training wait for one another, processes do not: many of few threads do more.

    Args:
        jobs, threads: what is decided already, >= 1.
    """
    whole = max(int(cores), 1)
    if jobs is None:
        jobs = min(max(whole // (threads or 1), 1), len(scenes))
        if memory is not None and jobs > 1:
            left = memory.total if memory.free is None else memory.free
            jobs = max(min(jobs, left // max(bytes_of(data, config) for data in scenes)), 1)
    return jobs, threads or max(whole // jobs, 1)


def bytes_of(data: Path, config: TrainConfig) -> int:
    """Memory, about, of a training on the pictures below a folder."""
    pixels = 0
    for path in data.rglob("*"):
        if path.suffix.lower() in PICTURES:
            with contextlib.suppress(UserError):
                width, height = image_size(path)
                pixels += width * height
    pixels = min(pixels, LARGE) // max(config.downscale, 1) ** 2
    return PER_PROCESS + PER_PIXEL * pixels + needed_for(pixels, config)
