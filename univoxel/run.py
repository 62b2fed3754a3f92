"""The folder of a run: what data it was trained on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from univoxel.data import Photos, keep_photos, load_photos
from univoxel.errors import DataError
from univoxel.files import read_json


@dataclass(frozen=True)
class Source:
    """Photographs that a run was trained on."""

    folder: Path
    downscale: int  # pixels of the files along a side of one that was trained on
    allow_outside: bool  # as of `load_photos`


def kept_photos(run: Path, split: str) -> Path:
    """The file of a run that keeps photographs of a split as they were shrunk or straightened."""
    return run / f"photographs_{split}.safetensors"


def trained_on(run: Path) -> Path:
    """The data set that a run's config.json names."""
    return _source_of(run).folder


def photos_of(run: Path, data: Path | None = None, split: str = "test") -> Photos:
    """Photographs at the size that a run was trained at; of another data set, if one is given.

    Args:
        split: "test", or "train" for those that were trained on.

    Raises:
        DataError: the run or the photographs cannot be read.
    """
    if data is not None and not (run / "config.json").is_file():
        return load_photos(data, split)
    source = _source_of(run)
    size, outside = source.downscale, source.allow_outside
    if data is not None and data != source.folder:
        return load_photos(data, split, size, allow_outside=outside)
    kept = kept_photos(run, split)
    photos = load_photos(source.folder, split, size, kept=kept, allow_outside=outside)
    keep_photos(photos, kept)
    return photos


def _source_of(run: Path) -> Source:
    """What photographs a run's config.json says that it was trained on."""
    path = run / "config.json"
    if not path.is_file():
        raise DataError(f"{run}: expected the folder of a run, got no {path.name}")
    config = read_json(path)
    if not isinstance(config, dict):
        raise DataError(f"{path}: expected an object with the configuration, got {config!r:.80}")
    # In runs from before there was a choice
    before = {"downscale": 0, "allow_outside": False}
    data, downscale, outside = ((before | config).get(f, "") for f in ("data", *before))
    kinds = type(data), type(downscale), type(outside)
    if kinds != (str, int, bool) or not data or "\0" in data or downscale < 0:
        raise DataError(
            f"{path}: expected data, a folder, and downscale, at least 0, got {data!r:.80} and "
            f"{downscale!r:.80}"
        )
    # 0 in runs from before a size was chosen for large photographs: those were refused
    return Source(Path(data), downscale or 1, outside)
