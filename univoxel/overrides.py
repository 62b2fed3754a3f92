"""Fields of a configuration by their path and a value in text, such as stages.1.voxels=3."""

from __future__ import annotations

import ast
import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from univoxel.errors import ConfigError, UserError


def changed(config: Any, changes: Iterable[str]) -> Any:
    """A frozen config with fields replaced: changes are "field.field=value".

    Raises:
        ConfigError: no such field, or a value of another type than the field has.
    """
    for change in changes:
        path, equals, text = change.partition("=")
        if not equals:
            raise ConfigError(f"changes={change}: expected FIELD=VALUE", "changes")
        try:
            config = _replaced(config, path.split("."), text)
        except UserError as error:
            raise ConfigError(f"changes={change}: {error}", "changes") from None
    return config


def _replaced(node: Any, path: list[str], text: str) -> Any:
    """A config, or a tuple of configs, in which the value at the path is what the text says."""
    if not path:
        return _value(node, text)
    name, *rest = path
    known = [str(i) for i in range(len(node))] if isinstance(node, tuple) else _fields(node)
    if name not in known:
        raise ConfigError(f"no field {name!r}, there are: {', '.join(known) or 'none'}")
    if isinstance(node, tuple):
        i = int(name)
        return (*node[:i], _replaced(node[i], rest, text), *node[i + 1 :])
    return dataclasses.replace(node, **{name: _replaced(getattr(node, name), rest, text)})


def _fields(node) -> list[str]:
    return [f.name for f in dataclasses.fields(node)] if dataclasses.is_dataclass(node) else []


def _value(old, text: str):
    """The text as a value of the same type as the old one."""
    if isinstance(old, Path):
        return Path(text)
    try:
        new = ast.literal_eval(text)
    except (ValueError, SyntaxError):
        new = text
    if isinstance(old, float) and type(new) is int:
        new = float(new)
    if type(new) is not type(old):
        raise ConfigError(f"expected a {type(old).__name__} such as {old!r}, got {text!r}")
    return new
