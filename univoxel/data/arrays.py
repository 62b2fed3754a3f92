"""Arrays in the files of NumPy."""

from __future__ import annotations

import tokenize
import zipfile
import zlib
from pathlib import Path

import numpy as np

from univoxel.data.inside import inside
from univoxel.errors import DataError

# What NumPy and zipfile raise of bytes that are none of theirs, or are broken
BROKEN = (
    *(OSError, EOFError, zipfile.BadZipFile, zlib.error, MemoryError),
    *(ValueError, TypeError, AttributeError, OverflowError),
    *(SyntaxError, tokenize.TokenError),  # headers are read as Python
    *(RuntimeError, NotImplementedError),  # encrypted; packed by a method that Python lacks
)


def read_npy(path: Path) -> np.ndarray:
    """The array in a .npy file.

    Raises:
        DataError: it cannot be read.
    """
    inside(path, str(path))
    try:
        with path.open("rb") as stream:
            array = np.load(stream, allow_pickle=False)
    except BROKEN as error:
        raise DataError(f"{path}: expected an array of NumPy, could not read it: {error}") from None
    if not isinstance(array, np.ndarray):
        raise DataError(f"{path}: expected one array of NumPy, got an archive of several")
    return array


def read_npz(path: Path, prefix: str = "") -> dict[str, np.ndarray]:
    """The arrays in a .npz file whose names begin with the prefix.

    Raises:
        DataError: it cannot be read, or holds something else than numbers.
    """
    inside(path, str(path))
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            found = {key: file[key] for key in file.files if key.startswith(prefix)}
    except BROKEN as error:
        raise DataError(f"{path}: expected an npz file, could not read it: {error}") from None
    for key, value in found.items():
        if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiub":
            kind = value.dtype if isinstance(value, np.ndarray) else type(value).__name__
            raise DataError(f"{path}: expected arrays of numbers, got {key} of {kind}")
    return found
