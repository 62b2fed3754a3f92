"""Arrays of many photographs, on disk where they are too large for memory.

Inside of `shelved` an array of LARGE bytes or more lies in a file that is mapped into memory and
that nobody else sees. The system writes its pages back and reads them as it has room; `release`
says of which it need keep none for this process. Elsewhere, and of smaller arrays, all this is
memory as usual.
"""

from __future__ import annotations

import math
import mmap
import os
import tempfile
import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

LARGE = 1 << 28  # bytes of an array from which on it lies on disk
DROP = getattr(mmap, "MADV_DONTNEED", None)  # of Linux: leaves what is written in the file

_folder: Path | None = None  # of `shelved`
_maps: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()  # all that are mapped


@contextmanager
def shelved(folder: Path) -> Iterator[None]:
    """A block in which large arrays lie in files of a folder, which vanish with their arrays."""
    global _folder
    before, _folder = _folder, folder
    try:
        yield
    finally:
        _folder = before


def is_large(shape: Sequence[int], dtype: torch.dtype) -> bool:
    """Whether an array is one for the disk, and there is a place for it."""
    if _folder is None or not hasattr(os, "posix_fallocate"):  # of Linux, beside others
        return False
    return math.prod(shape) * dtype.itemsize >= LARGE


def zeros(shape: Sequence[int], dtype: torch.dtype) -> Tensor:
    """Zeros, on disk if they are large.

    Raises:
        OSError: there is no room on the disk.
    """
    if not is_large(shape, dtype):
        return torch.zeros(tuple(shape), dtype=dtype)
    assert _folder is not None
    _folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=_folder, prefix=".univoxel-") as file:
        reserve(file.fileno(), math.prod(shape) * dtype.itemsize, _folder)
        return mapped(file.fileno(), 0, shape, dtype)


def reserve(descriptor: int, size: int, place: Path) -> None:
    """Make an open file as long, on the disk too: where that is full later, the process would end.

    Args:
        place: that an error names.

    Raises:
        OSError: there is no room.
    """
    try:
        os.posix_fallocate(descriptor, 0, size)
    except OSError as error:
        raise OSError(
            error.errno, f"no room for {size / 1e9:.1f} GB: {error.strerror}", str(place)
        ) from error


def mapped(descriptor: int, offset: int, shape: Sequence[int], dtype: torch.dtype) -> Tensor:
    """An array in an open file, which is changed with it; it stays when the file is closed.

    Args:
        offset: bytes before it, a multiple of those of a number.
    """
    size = math.prod(shape) * dtype.itemsize
    begin = offset - offset % mmap.ALLOCATIONGRANULARITY
    whole = mmap.mmap(descriptor, offset - begin + size, offset=begin)
    _maps.add(whole)
    flat = np.frombuffer(whole, np.uint8, size, offset - begin)
    return torch.from_numpy(flat).view(dtype).view(tuple(shape))


def release(array: Tensor | None = None) -> None:
    """Give back the memory of pages on disk: those of a contiguous array, or all.

    What was written stays. Of arrays in memory nothing is done.
    """
    if DROP is None or not _maps:
        return
    if array is None:
        for each in list(_maps):
            each.madvise(DROP)
        return
    if (found := _map_of(array)) is None:
        return
    whole, begin = found
    end = begin + array.numel() * array.element_size()
    low = begin // mmap.PAGESIZE * mmap.PAGESIZE
    whole.madvise(DROP, low, end - low)


def on_disk(array: Tensor) -> bool:
    """Whether an array lies on disk."""
    return _map_of(array) is not None


def flush(array: Tensor) -> None:
    """Write what an array holds to its file on disk: a crash of the machine does not lose it."""
    if (found := _map_of(array)) is not None:
        found[0].flush()


def _map_of(array: Tensor) -> tuple[mmap.mmap, int] | None:
    """The file that an array lies in, and where it begins there; None: it lies in memory."""
    begin = array.data_ptr()
    for each in list(_maps):
        first = np.frombuffer(each, np.uint8).ctypes.data
        if first <= begin < first + len(each):
            return each, begin - first
    return None
