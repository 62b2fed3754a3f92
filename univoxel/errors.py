"""Mistakes of a user, as exceptions with one root."""

from __future__ import annotations

from collections.abc import Sequence


def some(names: Sequence[object], most: int = 5) -> str:
    """The first of many names, for a message."""
    return ", ".join(map(str, names[:most])) + (", ..." if len(names) > most else "")


class Cancelled(Exception):
    """Raised in on_progress by a caller of the package: ends a training, which can be resumed."""


class UserError(ValueError):
    """A mistake of the user: the message says what was expected and what came.

    The command line shows it as one line. Every other exception, but for files of the user that
    cannot be read or written, is a fault of the program and keeps its traceback.

    Args:
        message: names Python arguments; a value to choose stands as `argument=value`.
        arguments: names in the message that the command line replaces by its options.
    """

    def __init__(self, message: str = "", *arguments: str) -> None:
        super().__init__(message)
        self.arguments = arguments


class ConfigError(UserError):
    """A configuration that contradicts itself, or a field of one that is out of range."""


class DataError(UserError):
    """Input that cannot be used: the message names the file, what was expected and what came."""


class WithoutMasks(DataError):
    """Photographs that nothing says of which pixels show the object."""


class StillBackground(DataError):
    """Photographs of an object that was turned before a still camera, and no masks of it.

    Args:
        seen: how that was seen.
    """

    def __init__(self, seen: str):
        super().__init__(
            f"{seen}: it seems that the object was turned before a static camera. Make masks of "
            "the object and pass them as masks=DIR, so that the background is ignored",
            "masks",
        )
        self.seen = seen


class NoSurface(UserError):
    """A scene without a surface, or none of it in any photograph."""


class FileError(UserError, OSError):
    """A file of the user that cannot be written."""


class MissingFile(FileError, FileNotFoundError):
    """A file that is expected and not there."""


class ExistingFile(FileError, FileExistsError):
    """A file or folder in the way, which would be overwritten."""


class MissingExtra(UserError, ImportError):
    """An optional package that is not installed: the message says how to install it."""


class MissingNative(UserError, RuntimeError):
    """A part of the compiled extension that was not built: the message says how to build it."""


class ProcessFailed(UserError, RuntimeError):
    """Another process, a training or a renderer, that did not end well or is in the way."""
