"""Photographs as training takes them, kept in a file: reading them again takes no time.

Only what was shrunk or straightened is kept; other photographs are read as fast from their files.
The file is one of safetensors with `color` and `alpha` as in `Photos`, and in its header what they
were made from and a checksum. A file that does not fit, or is broken, is passed over.
"""

from __future__ import annotations

import hashlib
import logging
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from univoxel.data.base import Photos
from univoxel.files import replacing

VERSION = 1  # of what is done to pixels: another one makes all files that are there unfit

log: logging.Logger = logging.getLogger("univoxel")
# Where photographs may have been kept. Layouts read photographs and need not know of it
_place: ContextVar[Path | None] = ContextVar("kept photographs", default=None)


@contextmanager
def looking_in(path: Path | None) -> Iterator[None]:
    """Let photographs that are read in the block come from this file, where they are in it."""
    token = _place.set(path)
    try:
        yield
    finally:
        _place.reset(token)


def origin_of(files: Sequence[Path], *treatment: object) -> str:
    """A name for pixels that are made of these files, as they are now, by that treatment."""
    digest = hashlib.sha256(repr((VERSION, *treatment)).encode())
    for file in files:
        facts = file.stat()
        digest.update(repr((str(file.resolve()), facts.st_size, facts.st_mtime_ns)).encode())
    return digest.hexdigest()


def kept_pixels(origin: str) -> tuple[Tensor, Tensor] | None:
    """Colour and alpha of that origin, if they were kept where `looking_in` says."""
    path = _place.get()
    if path is None or _origin_in(path) != origin:
        return None
    try:
        with safe_open(path, "pt") as file:
            color, alpha = file.get_tensor("color"), file.get_tensor("alpha")
            if file.metadata().get("checksum") == _checksum(color, alpha):
                return color, alpha
    except (OSError, SafetensorError):
        pass
    with suppress(OSError):  # of no use, and in the way of one that is
        path.unlink()
    return None


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
        log.info("photographs are not kept for the next time: %s", error)


def _origin_in(path: Path) -> str | None:
    """The origin of what a file holds; None where there is no file of this kind."""
    try:
        with safe_open(path, "pt") as file:
            return (file.metadata() or {}).get("origin")
    except (OSError, SafetensorError):
        return None


def _checksum(*tensors: Tensor) -> str:
    value = 0
    for tensor in tensors:
        value = zlib.crc32(tensor.flatten().view(torch.uint8).numpy().data, value)
    return f"{value:08x}"
