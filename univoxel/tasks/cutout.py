"""Cut an object out of photographs without masks: the part of the scene that stands in its place.

A coarse surface within a box and a backdrop around it explain the photographs together. What
cameras all around agree on inside the box is the object, and its silhouettes are the masks.
"""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

import torch
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
from torch import Tensor

from univoxel.bars import bar
from univoxel.data import Photos, load_photos, splits_of
from univoxel.data.images import write_exr, write_png
from univoxel.data.transforms import write_cameras
from univoxel.errors import ExistingFile
from univoxel.segmentation.config import SegmentationConfig
from univoxel.segmentation.distances import corners, surroundings
from univoxel.segmentation.separation import DEFAULTS, find_object, mask

log = logging.getLogger("univoxel")


def cutout(
    data: str | Path,
    out: str | Path,
    box: tuple[float, ...] | None = None,
    downscale: int = 0,
    seed: int = 0,
    config: SegmentationConfig = DEFAULTS,
) -> Path:
    """Write the photographs of a data set with masks as their alpha, and their cameras; return out.

    All splits are written, in the layout of NeRF-synthetic scenes, without lens distortion. The
    object is found from the training photographs alone.

    Args:
        out: folder to write.
        box: lower and upper corner of where the object is, world units; by default a cube around
            what the cameras look at, as large as their pictures.
        downscale: side of the squares of pixels that become one, 0 as of `load_photos`.
        config: how the object is found.

    Raises:
        DataError: photographs that cannot be used.
        ExistingFile: out is there already.
        UserError: the box is none, or, as NothingFound, no object is in it.
        OSError: a file cannot be written.
    """
    data, out = Path(data), Path(out)
    if out.exists():
        raise ExistingFile(f"{out} is there already: choose another out", "out")
    photos = load_photos(data, "train", downscale, masks=False)
    splits = {
        name: photos if name == "train" else load_photos(data, name, photos.downscale, masks=False)
        for name in splits_of(data)
    }
    log.info(photos.about)
    lower, upper = corners(box) if box else surroundings(photos.cameras)
    torch.manual_seed(seed)
    with bar(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %  {task.fields[facts]}"),
        TimeRemainingColumn(),
    ) as progress:
        steps = len(config.radii) * config.coarse.iterations + config.fine.iterations
        task = progress.add_task("object", total=steps, facts="")
        scene = find_object(
            photos,
            lower,
            upper,
            lambda db: progress.update(task, advance=1, facts=f"{db:.1f} dB"),
            config,
        )
        task = progress.add_task("masks", total=sum(map(len, splits.values())), facts="")
        # Nothing half-written goes by the name of out
        partial = out.with_name(f".{out.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        for name, split in splits.items():
            (partial / name).mkdir(parents=True)
            for view in range(len(split)):
                stem = partial / name / split.names[view]
                write_photo(stem, split, view, mask(scene, split, view))
                progress.advance(task)
            write_cameras(partial, name, split.cameras, split.names)
        partial.rename(out)
    return out


def write_photo(stem: Path, photos: Photos, view: int, alpha: Tensor) -> None:
    """Write a photograph as STEM.png, or STEM.exr where it is linear, with that alpha."""
    color, _ = photos.stored(view)
    if color.dtype == torch.uint8:
        rgba = torch.cat([color, torch.round(255 * alpha)[..., None].byte()], -1)
        write_png(stem.with_name(f"{stem.name}.png"), rgba)
    else:
        planes = {c: color[..., i] * alpha for i, c in enumerate("RGB")}
        write_exr(stem.with_name(f"{stem.name}.exr"), {**planes, "A": alpha})
