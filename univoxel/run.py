"""The folder of a run: what data it was trained on."""

from __future__ import annotations

from json import loads
from pathlib import Path

from univoxel.data import Photos, keep_photos, load_photos
from univoxel.errors import DataError


def kept_photos(run: Path, split: str) -> Path:
    """The file of a run that keeps photographs of a split as they were shrunk or straightened."""
    return run / f"photographs_{split}.safetensors"


def trained_on(run: Path) -> Path:
    """The data set that a run's config.json names."""
    return _data_of(run)[0]


def photos_of(run: Path, data: Path | None = None, split: str = "test") -> Photos:
    """Photographs at the size that a run was trained at; of another data set, if one is given.

    Args:
        split: "test", or "train" for those that were trained on.

    Raises:
        DataError: the run or the photographs cannot be read.
    """
    if data is not None and not (run / "config.json").is_file():
        return load_photos(data, split)
    folder, downscale = _data_of(run)
    if data is not None and data != folder:
        return load_photos(data, split, downscale)
    kept = kept_photos(run, split)
    photos = load_photos(folder, split, downscale, kept=kept)
    keep_photos(photos, kept)
    return photos


def _data_of(run: Path) -> tuple[Path, int]:
    """The data set that a run's config.json names, and how far its photographs were shrunk."""
    path = run / "config.json"
    try:
        config = loads(path.read_text(encoding="utf-8"))
        # 0 in runs from before a size was chosen for large photographs: those were refused
        return Path(config["data"]), int(config.get("downscale", 0)) or 1
    except FileNotFoundError:
        raise DataError(f"{run}: expected the folder of a run, got no {path.name}") from None
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise DataError(f"{path}: expected JSON with the key data: {error!r}") from None
