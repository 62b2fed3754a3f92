"""Checks of what configurations hold, in one form."""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from univoxel.errors import ConfigError
from univoxel.retired import without_retired

T = TypeVar("T")


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


def record(kind: type[T], values: object) -> T:
    """A dataclass from JSON: what dataclasses.asdict made of one and a file held.

    Tuples are lists in JSON, and paths are text; dataclasses are objects or, where they were read
    before, instances. Retired fields are passed over.

    Raises:
        ConfigError: names class and field: one that is missing or unknown, or a value of another
            type than the field's annotation; or what the class itself refuses.
    """
    name = kind.__name__
    if not isinstance(values, dict):
        raise ConfigError(f"{name}: expected an object, got {values!r:.60}")
    values = without_retired(kind, values)
    hints, known = get_type_hints(kind), {f.name: f for f in _fields(kind) if f.init}
    if unknown := values.keys() - known.keys():
        raise ConfigError(f"{name}: no field {min(map(str, unknown))!r:.60}")
    found = {}
    for field in known.values():
        if field.name in values:
            value = values[field.name]
            try:
                found[field.name] = _typed(hints[field.name], value)
            except (TypeError, OverflowError):
                wanted = getattr(hints[field.name], "__name__", hints[field.name])
                raise ConfigError(
                    f"{name}: {field.name} must be {wanted}, got {value!r:.60}"
                ) from None
        elif field.default is field.default_factory is dataclasses.MISSING:
            raise ConfigError(f"{name}: {field.name} is missing")
    return kind(**found)


def _fields(kind: Any) -> tuple[dataclasses.Field[Any], ...]:
    return dataclasses.fields(kind)


def _typed(hint: Any, value: Any) -> Any:
    """A value of JSON as the annotation has it.

    Raises:
        TypeError, OverflowError: it is of another type, or an integer that no float holds.
    """
    origin, inner = get_origin(hint), get_args(hint)
    if hasattr(value, "__dataclass_fields__") and isinstance(value, hint):  # read before
        return value
    if origin in (Union, types.UnionType):
        if value is None and type(None) in inner:
            return None
        for one in [kind for kind in inner if _has_fields(kind, value)] or inner:
            try:
                return _typed(one, value)
            except (TypeError, OverflowError):
                continue
    elif origin is Literal:
        if any(type(value) is type(one) and value == one for one in inner):
            return value
    elif origin is tuple and isinstance(value, list | tuple):
        many = inner[1:] == (...,)
        if many or len(inner) == len(value):
            each = inner[:1] * len(value) if many else inner
            return tuple(_typed(one, v) for one, v in zip(each, value, strict=True))
    elif hint is Path and isinstance(value, str):
        return Path(value)
    elif hint is float and type(value) in (int, float):
        return float(value)
    elif isinstance(hint, type) and (type(value) is hint or dataclasses.is_dataclass(hint)):
        return record(hint, value) if dataclasses.is_dataclass(hint) else value
    raise TypeError


def _has_fields(kind: Any, value: Any) -> bool:
    """Whether a type is no dataclass, or one with all fields that an object of JSON has."""
    if not dataclasses.is_dataclass(kind) or not isinstance(value, dict):
        return True
    return without_retired(kind, value).keys() <= {f.name for f in _fields(kind)}
