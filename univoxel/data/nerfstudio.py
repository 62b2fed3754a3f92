"""The layout of nerfstudio and instant-ngp.

transforms.json             see univoxel.data.transforms; aabb_scale, scale and offset say nothing
images/frame_00001.jpg      photographs, where file_path says
masks/frame_00001.png       masks, where mask_path says, or as COLMAP names them

train_filenames and test_filenames in the file are its splits, as far as they are there.
"""

from __future__ import annotations

from pathlib import Path

from univoxel.data.base import Photos
from univoxel.data.shots import Shot, every_eighth, read_shots, upright
from univoxel.data.transforms import read_frames, short, view_name, view_names
from univoxel.errors import DataError


def is_nerfstudio(folder: Path, split: str) -> bool:
    return (folder / "transforms.json").is_file()


def load_nerfstudio(
    folder: Path, split: str = "train", downscale: int = 0, masks: bool | Path = True
) -> Photos:
    """Photographs and cameras of one split: without one in the file, every eighth is for tests.

    Raises:
        DataError: one line that names the file, what was expected and what came.
    """
    path = folder / "transforms.json"
    root, shots, lost = read_frames(path)
    shots, remarks = upright(shots)
    chosen = root.get(f"{split}_filenames")
    if chosen is None:
        shots = every_eighth(folder, shots, split)
    else:
        listed = [frame["file_path"] for frame in root["frames"]]
        shots = _named(path, shots, listed, f"{split}_filenames", chosen)
    return read_shots(
        folder, "nerfstudio layout", split, shots, downscale, [*lost, *remarks], masks
    )


def _named(
    path: Path, shots: list[Shot], listed: list[str], key: str, chosen: object
) -> list[Shot]:
    """The shots of a split. What is listed and has no picture is left out of it, too."""
    if not isinstance(chosen, list) or not all(isinstance(name, str) for name in chosen):
        raise DataError(f"{path}: expected {key} as a list of file_paths, got {short(chosen)}")
    by_name, every = {shot.name: shot for shot in shots}, view_names(listed)
    known = {name: name for name in every} | dict(zip(listed, every, strict=True))
    names = [known.get(name) or known.get(view_name(name)) for name in chosen]
    if None in names or not names:
        came = view_name(chosen[names.index(None)]) if names else "an empty list"
        raise DataError(f"{path}: expected frames of the file in {key}, got {came}")
    found = [by_name[name] for name in names if name in by_name]
    if not found:
        raise DataError(f"{path}: expected frames with pictures in {key}, got {len(names)} without")
    return found
