"""Find the cameras of photographs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from univoxel.cli.parsing import takes, written
from univoxel.core.choices import FEATURE_SIZE, KEEP_SIZE
from univoxel.errors import UserError


@dataclass(frozen=True)
class PosesOptions:
    photographs: Annotated[Path, written("PHOTOS", positional=True)]
    """folder of JPEG, PNG, TIFF, WebP, HEIC or RAW, held either way; or a video"""
    out: Annotated[Path, written("SCENE")]
    """folder to write; its folder sfm/ keeps the steps and is of no use afterwards"""
    masks: Annotated[Path | None, written("DIR", "the whole pictures")] = None
    """folder with a mask for each photograph, white on the object: features are sought within them
    alone, as a turntable needs it"""
    every: Annotated[float | None, written("SECONDS", "80 frames in all")] = None
    """of a video, the sharpest frame of each so many seconds is taken"""
    keep_size: Annotated[int, written("PIXELS")] = KEEP_SIZE
    """most pixels along the longer side of written photographs; 0: as they are"""
    keep_weak: bool = False
    """write photographs too whose cameras may be off by degrees"""
    size: Annotated[int, written("PIXELS")] = FEATURE_SIZE
    """pixels along the longer side, in which features are sought"""
    features: Annotated[int | None, written("N", "4096; with --fast: 2048")] = None
    """most of a photograph"""
    fast: bool = False
    """fewer features, of larger details alone, in a quarter of the time; loses photographs of
    smooth objects"""
    seed: int = 0
    """of all random choices"""


@takes(PosesOptions)
def command(asked: PosesOptions) -> Path:
    """Find the cameras of photographs, or of the frames of a video.

    Writes them upright, with their cameras, as a new folder to train on, in COLMAP's layout. The
    same command again goes on after an interruption.
    """
    from univoxel.capture.config import DEFAULTS, FAST
    from univoxel.capture.poses import poses

    if asked.keep_size < 0:
        raise UserError(f"--keep-size must be at least 0, got {asked.keep_size}")
    if asked.every is not None and not asked.every > 0:
        raise UserError(f"--every must be above 0, got {asked.every:g}")
    config = replace(FAST if asked.fast else DEFAULTS, size=asked.size, seed=asked.seed)
    if asked.features is not None:
        config = replace(config, features=asked.features)
    how = {"keep_size": asked.keep_size, "keep_weak": asked.keep_weak, "config": config}
    return poses(asked.photographs, asked.out, asked.masks, asked.every, **how)
