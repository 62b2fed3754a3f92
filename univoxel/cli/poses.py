"""Find the camera poses of photographs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from univoxel.cli.parsing import ADVANCED, takes, written
from univoxel.core.choices import FEATURE_SIZE, KEEP_SIZE
from univoxel.errors import demand


@dataclass(frozen=True)
class PosesOptions:
    photographs: Annotated[Path, written("PHOTOS", positional=True)]
    """folder of JPEG, PNG, TIFF, WebP, HEIC or RAW photographs; or a video"""
    out: Annotated[Path, written("SCENE")]
    """folder to write to; you can delete its subfolder sfm/ when you are done"""
    masks: Annotated[Path | None, written("DIR", "the whole images")] = None
    """folder of masks inside which to detect features; required for a turntable"""
    every: Annotated[float | None, written("SECONDS", "80 frames in all")] = None
    """for a video: take the sharpest frame of each period of this length"""
    keep_size: Annotated[int, written("PIXELS", advanced=True)] = KEEP_SIZE
    """maximum width and height of the written photographs; 0: original size"""
    keep_weak: Annotated[bool, ADVANCED] = False
    """keep photographs with unreliable poses"""
    size: Annotated[int, written("PIXELS", advanced=True)] = FEATURE_SIZE
    """longer side of the images in which features are detected"""
    features: Annotated[int | None, written("N", "4096; with --fast: 2048", advanced=True)] = None
    """maximum number of features per photograph"""
    fast: bool = False
    """detect fewer features, four times faster; may lose views of smooth objects"""
    seed: Annotated[int, ADVANCED] = 0
    """random seed"""


@takes(PosesOptions)
def command(asked: PosesOptions) -> Path:
    """Find the camera poses of photographs or of a video.

    Writes upright photographs and their cameras to a new folder, in COLMAP's layout, which you can
    train on. After an interruption, run the same command again to resume.
    """
    from univoxel.capture.config import DEFAULTS, FAST
    from univoxel.capture.poses import poses

    demand(asked.keep_size >= 0, "keep_size", "at least 0", asked.keep_size)
    demand(asked.every is None or asked.every > 0, "every", "above 0", asked.every)
    config = replace(FAST if asked.fast else DEFAULTS, size=asked.size, seed=asked.seed)
    if asked.features is not None:
        config = replace(config, features=asked.features)
    how = {"keep_size": asked.keep_size, "keep_weak": asked.keep_weak, "config": config}
    return poses(asked.photographs, asked.out, asked.masks, asked.every, **how)
