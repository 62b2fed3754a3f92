"""Exceptions for mistakes of the user, with a common base class."""

from __future__ import annotations

from collections.abc import Sequence


def some(names: Sequence[object], most: int = 5) -> str:
    """The first of the names, joined for a message."""
    return ", ".join(map(str, names[:most])) + (", ..." if len(names) > most else "")


class Cancelled(Exception):
    """Raise this in on_progress to end a training run, which can then be resumed."""


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


def demand(holds: bool, name: str, wanted: str, value: object) -> None:
    """Refuse, by a UserError, an argument whose value is not as wanted."""
    if not holds:
        raise UserError(f"{name} must be {wanted}, got {value}", name)


class ConfigError(UserError):
    """A configuration is contradictory or has a field that is out of range."""


class DataError(UserError):
    """Input cannot be used: the message names the file, and what was expected and found."""


class WithoutMasks(DataError):
    """The photographs have no masks."""


class StillBackground(DataError):
    """Photographs without masks show an object that was rotated in front of a static camera.

    Args:
        seen: the evidence, in words.
    """

    def __init__(self, seen: str):
        super().__init__(
            f"{seen}: it seems that the object was rotated in front of a static camera. Make masks "
            "of the object and pass them as masks=DIR, so that the background is ignored",
            "masks",
        )
        self.seen = seen


class NoSurface(UserError):
    """The scene has no surface, or no photograph shows it."""


class FileError(UserError, OSError):
    """A file of the user cannot be written."""


class MissingFile(FileError, FileNotFoundError):
    """A file does not exist."""


class ExistingFile(FileError, FileExistsError):
    """A file or folder would be overwritten."""


class MissingExtra(UserError, ImportError):
    """An optional package is not installed: the message says how to install it."""


class MissingNative(UserError, RuntimeError):
    """A part of the compiled extension was not built: the message says how to build it."""


class ProcessFailed(UserError, RuntimeError):
    """Another process, such as a training run or a renderer, failed or is in the way."""
