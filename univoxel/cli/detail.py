"""A finer albedo for a trained run, from its full-size photographs."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from univoxel.cli.parsing import DataOf, Run, takes, written
from univoxel.core import log
from univoxel.core.choices import Detailing
from univoxel.errors import UserError, demand

if TYPE_CHECKING:
    from univoxel.data import Photos
    from univoxel.scene import Scene

DETAIL_SIZES = (256, 8192)
# What it takes on two quiet cores of a Xeon: charts, and a million pixels of photographs
CHARTS_SECONDS, MEGAPIXEL_SECONDS = 6.0, 0.02
MOST_OF_LIMIT = 0.25  # of the minutes that a training has


@dataclass(frozen=True)
class DetailOptions:
    """Photographs and size of the texture; a UserError for a size out of range."""

    run: Run
    """folder of a trained run"""
    data: DataOf = None
    """folder of the photographs, if they were moved"""
    size: Annotated[int | None, written("TEXELS", "from the photographs' resolution")] = None
    """width of the square texture, a power of 2 from 256 to 8192"""

    def __post_init__(self) -> None:
        (low, high), size = DETAIL_SIZES, self.size
        fits = size is None or (low <= size <= high and not size & (size - 1))
        demand(fits, "size", f"a power of 2 from {low} to {high}", size)


@takes(DetailOptions)
def command(asked: DetailOptions) -> Path | None:
    """Add a texture from full-size photographs to a run.

    Writes RUN/detail, unless the photographs show no more detail than the grid of the run.

    Raises:
        UserError: the run or its photographs cannot be read, or there is no surface.
        OSError: the texture cannot be written.
    """
    from univoxel.run import photos_of
    from univoxel.scene import load_scene

    run = Path(asked.run)
    data = None if asked.data is None else Path(asked.data)
    made = write(load_scene(run), photos_of(run, data, "train"), run, asked.size)
    if made is None:
        log.info(
            "%s: no texture was added, because photographs show no more detail than the grid", run
        )
    return made


def write(scene: Scene, photos: Photos, run: Path, size: int | None = None) -> Path | None:
    """Make the detail of a scene and write it beside its checkpoint; what was there goes."""
    import shutil

    from univoxel.detail.texture import FOLDER, make_detail, save_detail
    from univoxel.render.pictures import preview

    before = (run / FOLDER).is_dir()
    shutil.rmtree(run / FOLDER, ignore_errors=True)
    detail = make_detail(scene, photos, size)
    if before or detail is not None:
        seen, near = scene.registered(photos), detail and detail.near
        preview(scene, seen, run / "preview.png", albedo_near=near)
    if detail is None:
        return None
    save_detail(detail, run)
    return run / FOLDER


def minutes_left(
    minutes: float | None, photos: Photos, detail: Detailing, threads: int
) -> float | None:
    """Of a training's limit in minutes, what is left beside detail; None: it has no limit."""
    if minutes is None:
        return None
    seconds = seconds_for(photos, detail, threads)
    return minutes - min(seconds / 60, MOST_OF_LIMIT * minutes)


def seconds_for(photos: Photos, detail: Detailing, threads: int) -> float:
    """What detail takes of a quiet machine, about; 0: there is none."""
    if detail == "none" or photos.downscale == 1:
        return 0.0
    pixels = float(photos.cameras.size_of_each().double().prod(1).sum()) * photos.downscale**2
    return (CHARTS_SECONDS + MEGAPIXEL_SECONDS * pixels / 1e6) * 2 / max(threads, 1)


def made_after_training(
    scene: Scene, photos: Photos, run: Path, detail: Detailing, until: float | None
) -> Path | None:
    """`write`, where a configuration asks for it and `time.monotonic` is not past `until`."""
    if detail == "none":
        return None
    if until is not None and time.monotonic() > until:
        log.info("detail: no time was left for a texture: run `univoxel detail %s` to add it", run)
        return None
    try:
        return write(scene, photos, run)
    except (UserError, OSError, ValueError) as error:  # a run without it is one, too
        log.warning("detail: no texture was added: %s", error)
        return None
