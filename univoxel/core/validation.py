"""Checks of configurations, fields in files of earlier versions, and changes of fields by path."""

from __future__ import annotations

import ast
import dataclasses
import math
import types
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from univoxel.errors import ConfigError, UserError

# By class. What they said is a constant now, beside the code that uses it, or gone with that code
RETIRED: dict[str, frozenset[str]] = {
    "TrainConfig": frozenset({"compression", "confidence", "hollows", "preparation"}),
    "LossConfig": frozenset({"albedo_smoothness", "roughness_smoothness"}),
    "StageConfig": frozenset({"lr_poses"}),
    "JointConfig": frozenset(
        (
            "adam albedo_smoothness metal metallic mirror newton newton_roughness "
            "roughness_smoothness surface trials"
        ).split()
    ),
    "EntropyConfig": frozenset(
        (
            "albedo albedo_views cell degree min_color min_gain min_paint min_points min_reach "
            "min_sky min_views points steps sun_gain sun_shares sweeps teaching_weight"
        ).split()
    ),
}


# By class. Values of fields that a file may lack, where the class has another default by now: what
# the field had when versions up to 0.2 wrote files
EARLIER: dict[str, dict[str, Any]] = {
    "TrainConfig": {"scene": {}, "masks": "given", "cameras": "given", "exposures": False}
    | {"light_frame": "world", "detail": "none", "carving_seconds": 0.0, "capacity": "fixed"},
    "StageConfig": {"sharpness": [0.5, 0.5], "lr_sdf": [0.2, 0.02], "lr_networks": [3e-3, 3e-4]}
    | {"physical_from": 1.0, "patches_from": 1.0, "field": "dense"},
    "JointConfig": {"iterations": 700, "share": 0.4, "rays": 4096, "points": 20000}
    | {"newton_points": 4000},
    "SceneConfig": {"light": {}},
    "SGConfig": {"directions": 128},
}


def without_retired(kind: Any, values: dict[str, Any]) -> dict[str, Any]:
    """What a file holds of a configuration, but for fields that its class no longer has."""
    gone = RETIRED.get(kind.__name__, frozenset())
    return {name: value for name, value in values.items() if name not in gone}


# Meaning, unit and range of a field are in its metadata, once: checks and the reference page are
# derived from there.


T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Setting:
    """What a field of a configuration means, and which numbers it may be.

    A range is of each number of a tuple; None is in it where the annotation allows that.
    """

    meaning: str
    unit: str = ""
    above: float | None = None  # the range is open there
    least: float | None = None  # the range is closed there
    most: float = math.inf  # and here; numbers are finite in any case

    @property
    def range(self) -> str:
        """In words: above 0, at least 1, in [0, 1] or in [0, 1024]; or nothing."""
        low = self.least if self.above is None else self.above
        if low is None:
            return ""
        if self.most == math.inf:
            return f"{'at least' if self.above is None else 'above'} {low}"
        return f"in {'[' if self.above is None else '('}{low}, {self.most}]"

    def holds(self, value: Any) -> bool:
        """Whether a number is in the range."""
        low = value >= self.least if self.above is None else value > self.above
        high = value <= self.most and value < math.inf
        return low and high


def about(meaning: str, **rest: Any) -> dict[str, Setting]:
    """Metadata of a field without default: the fields of Setting."""
    return {"setting": Setting(meaning, **rest)}


def setting(default: T, meaning: str, **rest: Any) -> T:
    """A field with a default, which may be a frozen dataclass, and the fields of Setting."""
    return dataclasses.field(default=default, metadata=about(meaning, **rest))


def check_settings(config: Any) -> None:
    """Refuse, by a ConfigError, a configuration with a number out of its field's range, or a word
    that is no choice."""
    hints = _hints(type(config))
    for field in _fields(config):
        said = field.metadata.get("setting", Setting(""))
        if test := _test(hints[field.name], said):
            check_fields(config, *test, field.name)


@cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _test(hint: Any, said: Setting) -> tuple[str, Callable[[Any], bool]] | None:
    """What a field may be, in words and as a test; None: anything."""
    inner = get_args(hint)
    if get_origin(hint) is Literal:
        *first, last = map(str, inner)
        return f"{', '.join(first)} or {last}" if first else last, inner.__contains__
    wanted = said.range
    if not wanted:
        return None
    if get_origin(hint) is tuple:
        count = {2: "two", 3: "three"}[len(inner)]
        return (
            f"{count} numbers {wanted}",
            lambda x: len(x) == len(inner) and all(map(said.holds, x)),
        )
    if type(None) in inner:
        return f"None or {wanted}", lambda x: x is None or said.holds(x)
    return wanted, said.holds


def check_fields(config: object, wanted: str, holds: Callable[[Any], bool], *names: str) -> None:
    """Refuse, as `check_settings` does, a configuration whose named fields are not as wanted.

    Args:
        wanted: the range in words, such as "at least 1".
        holds: whether a value is in it; a TypeError or UnicodeError counts as no.
    """
    for name in names:
        value = getattr(config, name)
        try:
            held = holds(value)
        except (TypeError, UnicodeError):
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
        raise ConfigError(f"{name}: expected a JSON object, got {values!r:.60}")
    values = EARLIER.get(name, {}) | without_retired(kind, values)
    hints, known = _hints(kind), {f.name: f for f in _fields(kind) if f.init}
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
    """A value of JSON as the annotation has it; a TypeError where it is of another type, and an
    OverflowError for an integer that no float holds."""
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


# Fields of a configuration by their path and a value in text, such as stages.1.voxels=3.


def changed(config: Any, changes: Iterable[str]) -> Any:
    """A frozen config with fields replaced: changes are "field.field=value". A ConfigError if there
    is no such field, or the value is of another type."""
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
    if isinstance(node, tuple):
        known = [str(i) for i in range(len(node))]
    else:
        known = [f.name for f in _fields(node)] if hasattr(node, "__dataclass_fields__") else []
    if name not in known:
        raise ConfigError(f"no field {name!r}; the fields are: {', '.join(known) or 'none'}")
    if isinstance(node, tuple):
        i = int(name)
        return (*node[:i], _replaced(node[i], rest, text), *node[i + 1 :])
    return dataclasses.replace(node, **{name: _replaced(getattr(node, name), rest, text)})


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
        raise ConfigError(f"expected a value such as {old!r} ({type(old).__name__}), got {text!r}")
    return new
