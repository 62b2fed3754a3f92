"""Mistakes of a user, as exceptions."""

from __future__ import annotations


class UserError(ValueError):
    """A mistake of the user: the message says what was expected and what came.

    The command line shows it as one line. Every other exception is a fault of the program and
    keeps its traceback.
    """


class DataError(UserError):
    """Input that cannot be used: the message names the file, what was expected and what came."""


class NothingFound(UserError):
    """There is no surface in the box."""

    def __init__(self):
        super().__init__(
            "no object was found where the cameras look: say where it is with --box, or make masks"
        )
