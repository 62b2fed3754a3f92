"""Prepared photographs in a file, so that they need not be read again.

Only what was shrunk or straightened is kept, and what is too large for memory; other photographs
are read as fast from their files.
The file is one of safetensors with `color` and `alpha` as in `Photos`, and in its header what they
were made from and a checksum. A file that does not fit, or is broken, is passed over.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import zlib
from collections.abc import Sequence
from contextlib import AbstractContextManager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from univoxel.core import log, memmap, system
from univoxel.core.files import replacing
from univoxel.data.photos import Photos

# What is raised of files that are none of ours, or broken
UNFIT = (OSError, SafetensorError, ValueError, KeyError, TypeError, AttributeError)
HEADER = 4096  # bytes of the header of a file that is written while photographs are read
FLUSHED = 16  # photographs after which what was read is safe on disk
DTYPES = {"U8": torch.uint8, "F32": torch.float32}  # by their names in safetensors
VERSION = 4  # of what is done to pixels: another one makes all files that are there unfit

# Where photographs may have been kept. Layouts read photographs and need not know of it
_place: ContextVar[Path | None] = ContextVar("kept photographs", default=None)


def looking_in(path: Path | None) -> AbstractContextManager[None]:
    """Let photographs that are read in the block come from this file, where they are in it."""
    return memmap.assigned(_place, path)


def origin_of(files: Sequence[Path], *treatment: object) -> str:
    """A name for pixels that are made of these files, as they are now, by that treatment."""
    digest = hashlib.sha256(repr((VERSION, *treatment)).encode())
    for file in files:
        facts = file.stat()
        digest.update(repr((str(file.resolve()), facts.st_size, facts.st_mtime_ns)).encode())
    return digest.hexdigest()


def kept_pixels(origin: str) -> tuple[Tensor, Tensor] | None:
    """Colour and alpha of that origin, if they were kept where `looking_in` says; large ones are
    the file itself."""
    path = _place.get()
    if path is None or _origin_in(path) != origin:
        return None
    try:
        color, alpha, facts = _opened(path)
        if facts.get("checksum") == _checksum(color, alpha):
            return color, alpha
    except UNFIT:
        pass
    with suppress(OSError):  # of no use, and in the way of one that is
        path.unlink()
    return None


def to_be_kept(views: int, height: int, width: int) -> bool:
    """Whether photographs of 8 bits are so large that they are read into a file."""
    return _place.get() is not None and memmap.is_large((views, height, width, 3), torch.uint8)


@dataclass
class Reading:
    """Photographs while they are read, one after the other: in memory, or where they are large in
    the file where they are kept. There, reading that was ended continues where it was."""

    color: Tensor  # [V, H, W, 3]
    alpha: Tensor  # [V, H, W]
    partial: Path | None = None  # the file, under the name that it has meanwhile
    origin: str = ""
    read: int = 0  # photographs that are whole
    empty: bool = True  # whether all of them are
    opaque: bool = True  # the same

    @staticmethod
    def resumed(origin: str) -> Reading | None:
        """What an earlier process has read of photographs of that origin."""
        path = _place.get()
        if not origin or path is None or _origin_in(partial := _partial(path)) != origin:
            return None
        try:
            color, alpha, facts = _opened(partial)
            state = json.loads(facts["reading"])
            if not memmap.on_disk(color):
                return None
            return Reading(color, alpha, partial, origin, **state)
        except UNFIT:
            return None

    @staticmethod
    def begun(origin: str, color: Tensor, alpha: Tensor, size: tuple[int, int, int]) -> Reading:
        """Room for photographs [V, H, W], all stored as this one is; an OSError where the disk has
        none for what is large."""
        path, shape = _place.get(), (*size, 3)
        if not origin or path is None or not memmap.is_large(shape, color.dtype):
            return Reading(color.new_zeros(shape), alpha.new_zeros(size))
        path.parent.mkdir(parents=True, exist_ok=True)
        reading = Reading(torch.empty(0), torch.empty(0), _partial(path), origin)
        _write_empty(_partial(path), {"color": (shape, color.dtype), "alpha": (size, alpha.dtype)})
        _set_facts(_partial(path), reading._facts())
        reading.color, reading.alpha, _ = _opened(_partial(path))
        return reading

    def done(self, view: int) -> None:
        """Note that a photograph is whole."""
        self.read = view + 1
        if self.partial is not None and self.read % FLUSHED == 0:
            system.flush(self.partial)
            _set_facts(self.partial, self._facts())

    def drop(self) -> None:
        """Leave no file."""
        if self.partial is not None:
            self.partial.unlink(missing_ok=True)

    def finished(self) -> tuple[Tensor, Tensor]:
        """Colour and alpha of all; the file has its name."""
        if self.partial is not None and (path := _place.get()) is not None:
            system.flush(self.partial)
            checksum = _checksum(self.color, self.alpha)
            _set_facts(self.partial, {"origin": self.origin, "checksum": checksum})
            system.replace(self.partial, path)
        return self.color, self.alpha

    def _facts(self) -> dict[str, str]:
        state = {"read": self.read, "empty": self.empty, "opaque": self.opaque}
        return {"origin": self.origin, "reading": json.dumps(state)}


def _partial(path: Path) -> Path:
    return path.with_name(f".{path.name}.partial")


def _write_empty(path: Path, arrays: dict[str, tuple[Sequence[int], torch.dtype]]) -> None:
    """A file of safetensors with zeros, in whose header there is room for facts."""
    header, end = {}, 0
    # The wider numbers first: so all are aligned
    for name, (shape, dtype) in sorted(arrays.items(), key=lambda item: -item[1][1].itemsize):
        begin, end = end, end + math.prod(shape) * dtype.itemsize
        kind = "U8" if dtype == torch.uint8 else "F32"
        header[name] = {"dtype": kind, "shape": list(shape), "data_offsets": [begin, end]}
    with path.open("wb") as file:
        file.write(_encoded(header))
        file.flush()
        memmap.reserve(file.fileno(), 8 + HEADER + end, path)


def _encoded(header: dict[str, Any]) -> bytes:
    return HEADER.to_bytes(8, "little") + json.dumps(header).encode().ljust(HEADER)


def _header(path: Path) -> tuple[dict[str, Any], int]:
    """The header of a file of safetensors, and its length."""
    with path.open("rb") as file:
        length = int.from_bytes(file.read(8), "little")
        return json.loads(file.read(length)), length


def _set_facts(path: Path, facts: dict[str, str]) -> None:
    """Replace what a file of `_write_empty` says of itself."""
    header = _header(path)[0] | {"__metadata__": facts}
    with path.open("r+b") as file:
        file.write(_encoded(header))


def _opened(path: Path) -> tuple[Tensor, Tensor, dict[str, str]]:
    """Colour, alpha and facts of a file; large arrays are the file itself."""
    header, length = _header(path)
    color, alpha = (
        (8 + length + about["data_offsets"][0], about["shape"], DTYPES[about["dtype"]])
        for about in (header["color"], header["alpha"])
    )
    if memmap.is_large(*color[1:]) and os.access(path, os.W_OK):
        arrays = memmap.mapped(path, *color), memmap.mapped(path, *alpha)
        return *arrays, header.get("__metadata__", {})
    with safe_open(path, "pt") as file:
        return file.get_tensor("color"), file.get_tensor("alpha"), file.metadata() or {}


def keep_photos(photos: Photos, path: Path) -> None:
    """Write photographs that were shrunk or straightened to a file, unless it has them already.

    Whole or not at all. Where it cannot be written the log says so: nothing else depends on it.
    """
    if not photos.origin or _origin_in(path) == photos.origin:
        return
    tensors = {"color": photos.color, "alpha": photos.alpha}
    facts = {"origin": photos.origin, "checksum": _checksum(photos.color, photos.alpha)}
    try:
        with replacing(path) as temporary:
            save_file(tensors, temporary, facts)
    except (OSError, SafetensorError) as error:
        log.info("prepared photographs could not be stored for the next run: %s", error)


def _origin_in(path: Path) -> str | None:
    """The origin of what a file holds; None if there is no file of this kind."""
    try:
        with safe_open(path, "pt") as file:
            return (file.metadata() or {}).get("origin")
    except (OSError, SafetensorError):
        return None


def _checksum(*tensors: Tensor) -> str:
    value = 0
    for tensor in tensors:
        for picture in tensor:
            value = zlib.crc32(picture.flatten().view(torch.uint8).numpy().data, value)
    return f"{value:08x}"
