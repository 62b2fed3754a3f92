"""A capture in a process of its own, which ends itself with SIGKILL in the step that it is told.

python tests/capturing.py PHOTOS MASKS OUT [STEP]
"""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from univoxel.capture import cutout, structure
from univoxel.capture.config import CaptureConfig
from univoxel.cli import capture as task
from univoxel.cli import trainer
from univoxel.data import images

# Enough for pictures of this size
CONFIG = CaptureConfig(features=1000, first_octave=0, exhaustive=10, partners=8)
PICTURES = task.PicturesConfig(frames=2, resolution=48, samples=2)
CHANGES = tuple(
    f"stages.{stage}.{field}"
    for stage in (0, 1)
    for field in ("voxels=0.02", "iterations=20", "rays=128")
)


def make(given: tuple[Path, Path], out: Path) -> task.Captured:
    """A capture of little work, of photographs and a folder of masks."""
    photographs, masks = given
    options: Any = {"preset": "draft", "light": "baked", "changes": CHANGES}
    return task.capture(photographs, out, masks=masks, **options, config=CONFIG, pictures=PICTURES)


def kill_in(step: str) -> None:
    """Let this process be killed in the middle of a step."""
    match step:
        case "cameras":  # features are there, matches are not
            _kill_at(structure, "match", 0)
        case "masks":
            _kill_at(cutout, "write_photo", 5)
        case "training":  # the first stage is saved
            _kill_at(trainer, "make_stage_", 1)
        case "mesh":
            _kill_writing(".glb")
        case "pictures":
            _kill_at(images, "write_png", 1)
        case "page":
            _kill_writing(".html")


def _kill_at(module: object, name: str, calls: int) -> None:
    """Be killed in the call after so many."""
    function: Callable = getattr(module, name)
    left = iter(range(calls))

    def call(*args, **kwargs):
        if next(left, None) is None:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*args, **kwargs)

    setattr(module, name, call)


def _kill_writing(suffix: str) -> None:
    """Be killed with a file written and not yet in its place."""
    replace = os.replace

    def call(source, target):
        if Path(target).suffix == suffix and Path(target).parent == OUT:
            os.kill(os.getpid(), signal.SIGKILL)
        replace(source, target)

    os.replace = call  # pyright: ignore[reportAttributeAccessIssue]


if __name__ == "__main__":
    PHOTOGRAPHS, MASKS, OUT = map(Path, sys.argv[1:])
    for name in task.STEPS:
        child = os.fork()
        if not child:
            kill_in(name)
            make((PHOTOGRAPHS, MASKS), OUT)
            os._exit(0)
        _, status = os.waitpid(child, 0)
        files = sorted(p.relative_to(OUT).as_posix() for p in OUT.rglob("*") if p.is_file())
        print(json.dumps([name, os.WTERMSIG(status), files]), flush=True)
