"""Exceptions for mistakes of the user, with a common base class."""

from __future__ import annotations

from collections.abc import Sequence


def some(names: Sequence[object], most: int = 5) -> str:
    """The first of the names, joined for a message."""
    return ", ".join(map(str, names[:most])) + (", ..." if len(names) > most else "")


class Cancelled(Exception):
    """Raise it in on_progress to end a training, which can then be resumed."""


class UserError(ValueError):
    """A mistake of the user: the message says what was expected and what was found.

    The command line prints it as one line. All other exceptions, except for user files that cannot
    be read or written, are bugs of the program and keep their traceback.

    Args:
        message: refers to Python arguments; a value to choose is written as `argument=value`.
        arguments: names in the message that the command line replaces with its options.
    """

    def __init__(self, message: str = "", *arguments: str) -> None:
        super().__init__(message)
        self.arguments = arguments


class ConfigError(UserError):
    """A configuration that is contradictory, or has a field that is out of range."""


class DataError(UserError):
    """Input that cannot be used: the message names the file, and what was expected and found."""


class WithoutMasks(DataError):
    """Photographs without masks."""


class StillBackground(DataError):
    """Photographs without masks of an object that was turned before a static camera.

    Args:
        seen: the evidence, in words.
    """

    def __init__(self, seen: str):
        super().__init__(
            f"{seen}: it seems that the object was rotated before a static camera. Make masks of "
            "the object and pass them as masks=DIR, so that the background is ignored",
            "masks",
        )
        self.seen = seen


class NoSurface(UserError):
    """A scene without a surface, or whose surface is in no photograph."""


class FileError(UserError, OSError):
    """A file of the user that cannot be written."""


class MissingFile(FileError, FileNotFoundError):
    """A file that does not exist."""


class ExistingFile(FileError, FileExistsError):
    """A file or folder that would be overwritten."""


class MissingExtra(UserError, ImportError):
    """An optional package is not installed: the message says how to install it."""


class MissingNative(UserError, RuntimeError):
    """A part of the compiled extension was not built: the message says how to build it."""


class ProcessFailed(UserError, RuntimeError):
    """Another process, such as a training or a renderer, failed or is in the way."""
