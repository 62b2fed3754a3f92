"""Checks of what configurations hold, in one form."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from univoxel.errors import ConfigError


def check_fields(config: object, wanted: str, holds: Callable[[Any], bool], *names: str) -> None:
    """Refuse a configuration whose named fields are not as wanted.

    Args:
        config: a dataclass.
        wanted: the range in words, such as "at least 1".
        holds: whether a value is in it; a TypeError counts as no.

    Raises:
        ConfigError: names class and field, says what is wanted and what came.
    """
    for name in names:
        value = getattr(config, name)
        try:
            held = holds(value)
        except TypeError:
            held = False
        if not held:
            raise ConfigError(f"{type(config).__name__}: {name} must be {wanted}, got {value!r}")
