"""Large arrays of photographs, in files if memory is too small, and parallel work on them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor

from univoxel.core import system

# Inside of `large_arrays_in` an array of LARGE bytes or more is a file that is mapped into memory
# and that nobody else sees. The system keeps its pages as it has room, and writes back and reads
# again those that it has not. Elsewhere, and of smaller arrays, all this is memory as usual.


LARGE = 1 << 28  # bytes of an array from which on it is a file

Item = TypeVar("Item")
Result = TypeVar("Result")
_folder: ContextVar[Path | None] = ContextVar("folder of large arrays", default=None)


@contextmanager
def assigned(variable: ContextVar[Item], value: Item) -> Iterator[None]:
    """A block in which a variable has a value."""
    token = variable.set(value)
    try:
        yield
    finally:
        variable.reset(token)


def large_arrays_in(folder: Path) -> AbstractContextManager[None]:
    """A block in which large arrays are files of a folder, which vanish with their arrays."""
    return assigned(_folder, folder)


def is_large(shape: Sequence[int], dtype: torch.dtype) -> bool:
    """Whether an array is one for a file, and there is a place for it."""
    return (
        system.can_map()
        and _folder.get() is not None
        and math.prod(shape) * dtype.itemsize >= LARGE
    )


def zeros(shape: Sequence[int], dtype: torch.dtype) -> Tensor:
    """Zeros, in a file if they are large; an OSError where the disk has no room."""
    folder = _folder.get()
    if folder is None or not is_large(shape, dtype):
        return torch.zeros(tuple(shape), dtype=dtype)
    folder.mkdir(parents=True, exist_ok=True)
    with system.vanishing_file(folder) as (descriptor, path):
        reserve(descriptor, math.prod(shape) * dtype.itemsize, folder)
        return mapped(path, 0, shape, dtype)


def reserve(descriptor: int, size: int, place: Path) -> None:
    """Make an open file as long, on the disk too: where that is full later, the process would end.
    An OSError, which names the place, if there is no room."""
    try:
        system.reserve(descriptor, size)
    except OSError as error:
        raise OSError(
            error.errno, f"no space left for {size / 1e9:.1f} GB: {error.strerror}", str(place)
        ) from error


def mapped(path: Path, offset: int, shape: Sequence[int], dtype: torch.dtype) -> Tensor:
    """An array in a file, from a number of bytes on, which is changed with it.

    Raises:
        ValueError: the offset is no multiple of the bytes of a number, or the file is too short.
        OSError: the file cannot be written.
    """
    if offset % dtype.itemsize:
        raise ValueError(f"{path}: offset {offset} is not a multiple of {dtype.itemsize} bytes")
    end = offset + math.prod(shape) * dtype.itemsize
    if (size := path.stat().st_size) < end:  # it would be made longer, with zeros
        raise ValueError(f"{path}: expected {end} bytes, got {size}")
    whole = torch.UntypedStorage.from_file(str(path), shared=True, nbytes=end)
    flat = torch.empty(0, dtype=torch.uint8).set_(whole)  # pyright: ignore[reportArgumentType]
    return flat[offset:].view(dtype).view(tuple(shape))


def on_disk(array: Tensor) -> bool:
    """Whether an array is a file."""
    return array.untyped_storage().filename is not None


# Independent pieces of work, side by side.


def parallel_map(call: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """The results of `call`, in order; as many are made at once as torch has threads.

    torch's own threads share out single operations. Where many small ones follow one another, a
    thread for each piece, whose numbers stay in its core's cache, is several times as fast.
    """
    threads = torch.get_num_threads()
    if threads == 1:
        return [call(item) for item in items]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(call, items))
