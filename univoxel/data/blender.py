"""The layout of NeRF-synthetic scenes, of Shiny Blender, Synthetic4Relight and Stanford-ORB.

transforms_<split>.json     see univoxel.data.transforms
<file_path>[.png]           RGBA photograph, straight alpha, sRGB; or with <file_path>_alpha.png
<file_path>_rgba.png        the same
<file_path>_rgb.exr         linear photograph, with <file_path>_mask.png
train/0001.exr              linear photograph, with train_mask/0001.png
transforms_novel.json       views of other scenes, as of Stanford-ORB: split "novel"
"""

from __future__ import annotations

from pathlib import Path

from univoxel.data.base import Photos
from univoxel.data.shots import read_shots
from univoxel.data.transforms import read_frames
from univoxel.errors import DataError


def is_blender(folder: Path, split: str) -> bool:
    return any((folder / f"transforms_{s}.json").is_file() for s in ("train", split))


def load_blender(
    folder: Path, split: str = "train", downscale: int = 0, masks: bool | Path = True
) -> Photos:
    """Photographs and cameras of one split.

    Raises:
        DataError: one line that names the file, what was expected and what came.
    """
    path = folder / f"transforms_{split}.json"
    if not path.is_file():
        raise DataError(f"{folder}: expected {path.name} beside transforms_train.json, got none")
    _, shots, remarks = read_frames(path)
    return read_shots(folder, "NeRF layout", split, shots, downscale, remarks, masks)
