"""Whether files that others name lie in the data's folder: a data set may come from anybody."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

from univoxel.errors import DataError

# The folder that files must lie in, resolved. Layouts find files and need not know of it
_folder: ContextVar[Path | None] = ContextVar("folder of the data", default=None)


@contextmanager
def staying_in(folder: Path | None) -> Iterator[None]:
    """Let `inside` refuse, in the block, what does not lie in the folder; None: nothing."""
    token = _folder.set(None if folder is None else folder.resolve())
    try:
        yield
    finally:
        _folder.reset(token)


def inside(path: Path, where: str) -> Path:
    """The path, if it may be read, once links are followed.

    Args:
        where: for messages: what says that it is there.

    Raises:
        DataError: it lies outside of the folder that `staying_in` names.
    """
    folder = _folder.get()
    if folder is not None and not path.resolve().is_relative_to(folder):
        raise DataError(
            f"{where}: expected files in {folder}, got {path.resolve()}: if you trust where the "
            "data comes from, set allow_outside",
            "allow_outside",
        )
    return path
