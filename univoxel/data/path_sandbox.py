"""Files that a data set names: they must exist inside its folder; and NumPy arrays in files."""

from __future__ import annotations

import tokenize
import zipfile
import zlib
from collections.abc import Sequence
from contextlib import AbstractContextManager
from contextvars import ContextVar
from pathlib import Path

import numpy as np

from univoxel.core import log
from univoxel.core.memmap import assigned
from univoxel.errors import DataError, some

# The folder that files must lie in, resolved. Layouts find files and need not know of it
_folder: ContextVar[Path | None] = ContextVar("folder of the data", default=None)


def staying_in(folder: Path | None) -> AbstractContextManager[None]:
    """Let `inside` refuse, in the block, what does not lie in the folder; None: nothing."""
    return assigned(_folder, None if folder is None else folder.resolve())


def inside(path: Path, where: str) -> Path:
    """The path, if it may be read, once links are followed; a DataError of `where`, which says that
    it is there, if it lies outside of the folder that `staying_in` names."""
    folder = _folder.get()
    if folder is not None and not path.resolve().is_relative_to(folder):
        raise DataError(
            f"{where}: expected files inside {folder}, got {path.resolve()}: if you trust the "
            "source of the data, set allow_outside",
            "allow_outside",
        )
    return path


def entries(folder: Path) -> list[Path]:
    """What is in a folder, by name; nothing where it may not be listed."""
    try:
        return sorted(folder.iterdir())
    except OSError:
        return []


# Pictures that a data set lists and does not have: left out, as long as enough remain.


FEWEST = 3  # photographs that must be there where one is missing: a shape needs that many views
SHARE = 0.5  # of those listed that must be there: with less, it is the names that are wrong
NAMED = 3  # missing pictures that messages name, at most


def left_out(where: str, missing: Sequence[object], listed: int, note: str = "") -> list[str]:
    """What is to be said of pictures that are missing, by name or path; the log warns of them. A
    DataError where fewer than FEWEST are there, or than SHARE of those listed.

    Args:
        where: what lists them, for messages.
        note: where they were looked for, for the error.
    """
    if not missing:
        return []
    names = some(missing, NAMED)
    count = f"{len(missing)} of {listed}"
    if listed - len(missing) < max(FEWEST, SHARE * listed):
        raise DataError(
            f"{where}: missing images: {names} ({count}); expected at least half of all images, "
            f"and at least {FEWEST}{note}"
        )
    log.warning("%s: missing images: %s (%s left out)", where, names, count)
    return [f"{count} listed images were left out because they are missing"]


# Arrays in the files of NumPy.


# What NumPy and zipfile raise of bytes that are none of theirs, or are broken
BROKEN = (
    *(OSError, EOFError, zipfile.BadZipFile, zlib.error, MemoryError),
    *(ValueError, TypeError, AttributeError, OverflowError),
    *(SyntaxError, tokenize.TokenError),  # headers are read as Python
    *(RuntimeError, NotImplementedError),  # encrypted; packed by a method that Python lacks
)


def read_npy(path: Path) -> np.ndarray:
    """The array in a .npy file; a DataError where it cannot be read."""
    inside(path, str(path))
    try:
        with path.open("rb") as stream:
            array = np.load(stream, allow_pickle=False)
    except BROKEN as error:
        raise DataError(f"{path}: this NumPy array could not be read: {error}") from None
    if not isinstance(array, np.ndarray):
        raise DataError(f"{path}: expected one NumPy array, got an archive of several")
    return array


def read_npz(path: Path, prefix: str = "") -> dict[str, np.ndarray]:
    """The arrays in a .npz file whose names begin with the prefix; a DataError where it cannot be
    read, or holds something else than numbers."""
    inside(path, str(path))
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            found = {key: file[key] for key in file.files if key.startswith(prefix)}
    except BROKEN as error:
        raise DataError(f"{path}: this npz file could not be read: {error}") from None
    for key, value in found.items():
        if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiub":
            kind = value.dtype if isinstance(value, np.ndarray) else type(value).__name__
            raise DataError(f"{path}: expected arrays of numbers, but {key} is of type {kind}")
    return found
