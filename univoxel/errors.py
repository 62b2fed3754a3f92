"""Mistakes of a user, as exceptions."""

from __future__ import annotations


class DataError(ValueError):
    """Input that cannot be used: the message names the file, what was expected and what came."""


class NothingFound(ValueError):
    """There is no surface in the box."""

    def __init__(self):
        super().__init__(
            "no object was found where the cameras look: say where it is with --box, or make masks"
        )
