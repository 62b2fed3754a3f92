"""Reference pages from the code: command line, configuration, ops."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
import textwrap
import types
import typing
from collections.abc import Callable, Iterator
from typing import Any


def command_line() -> str:
    """A section for each command: what it does, and a table of its options."""
    from univoxel.cli import COMMANDS, laboratory

    named = COMMANDS | {f"lab {name}": function for name, function in laboratory().items()}
    return "\n\n".join(_command(name, function) for name, function in named.items())


def help_screen() -> str:
    """What `univoxel` alone prints."""
    from univoxel import cli

    return f"```text\n{cli.help_screen([])}\n```"


def configuration() -> str:
    """A section for each dataclass that a training's configuration consists of."""
    from univoxel.config import TrainConfig

    places = _places(TrainConfig)
    return "\n\n".join(_fields(cls, paths) for cls, paths in places.items())


def ops_table() -> str:
    """A line for each public op."""
    rows = [f"| `{name}` | {_cell(_summary(op))} |" for name, op in _ops().items()]
    return "\n".join(["| op | what it does |", "|---|---|", *rows])


def ops() -> str:
    """A section for each public op: signature and docstring."""
    return "\n\n".join(_op(name, op) for name, op in _ops().items())


GENERATORS: dict[str, Callable[[], str]] = {
    "command-line": command_line,
    "help-screen": help_screen,
    "configuration": configuration,
    "ops": ops,
    "ops-table": ops_table,
}


# Command line


def _command(name: str, function: Callable) -> str:
    from univoxel.cli.parsing import documentation, hints_of

    hints = hints_of(function)
    summary, description, meanings = _parts(documentation(function))
    rows = []
    for parameter in inspect.signature(function).parameters.values():
        option, values = _option(parameter, hints[parameter.name])
        default = _default(parameter, hints[parameter.name])
        rows.append(f"| {option} | {values} | {default} | {_cell(meanings[parameter.name])} |")
    table = ["| argument | values | default | meaning |", "|---|---|---|---|", *rows]
    return "\n\n".join(p for p in (f"## {name}", summary, description, "\n".join(table)) if p)


def _option(parameter: inspect.Parameter, hint: Any) -> tuple[str, str]:
    """How an argument is written, and the values that it takes."""
    metavar = next((m.metavar for m in _metadata(hint) if m.metavar), None)
    kinds = list(_leaves(hint))
    choices = [str(c) for kind in kinds for c in typing.get_args(kind) if _is_literal(kind)]
    if any(m.positional for m in _metadata(hint)):
        return f"`{metavar or parameter.name.upper()}`".replace("|", "\\|"), ""
    named = next((m.name for m in _metadata(hint) if m.name), parameter.name)
    flag = "--" + named.replace("_", "-")
    if kinds == [bool]:
        return f"`{flag}`", "a flag"
    if choices and metavar is None:
        return f"`{flag}`", ", ".join(f"`{c}`" for c in choices)
    numbers = {int: "a whole number", float: "a number"}
    shown = metavar or next((numbers[k] for k in kinds if k in numbers), "text")
    return f"`{flag}`", f"`{shown}`".replace("|", "\\|") if metavar else shown


def _default(parameter: inspect.Parameter, hint: Any) -> str:
    for text in (m.hint for m in _metadata(hint)):
        if text:
            return re.sub(r"^(?:default: )?(.*)$", r"\1", text.strip("()"))
    if parameter.default is inspect.Parameter.empty:
        return "required"
    if parameter.default is None or parameter.default == () or parameter.default is False:
        return ""
    if isinstance(parameter.default, tuple):
        return " ".join(f"`{value}`" for value in parameter.default)
    return f"`{parameter.default}`"


def _metadata(hint: Any) -> Iterator[Any]:
    """Annotations of a type and of the types in it."""
    yield from getattr(hint, "__metadata__", ())
    for inner in typing.get_args(hint):
        if typing.get_origin(inner) is not None:
            yield from _metadata(inner)


def _leaves(hint: Any) -> Iterator[Any]:
    """Types that a hint is composed of; a Literal is one."""
    arguments = [a for a in typing.get_args(hint) if a not in (type(None), ...)]
    if _is_literal(hint) or not arguments:
        yield hint
    elif hasattr(hint, "__metadata__"):
        yield from _leaves(arguments[0])
    else:
        for inner in arguments:
            yield from _leaves(inner)


def _is_literal(hint: Any) -> bool:
    return typing.get_origin(hint) is typing.Literal


def _parts(doc: str) -> tuple[str, str, dict[str, str]]:
    """First line, description, and text of each argument, of a docstring."""
    head, _, arguments = doc.partition("\nArgs:\n")
    summary, _, description = head.strip().partition("\n")
    entries = re.findall(r"^    (\w+): (.*(?:\n     .*)*)", arguments, re.MULTILINE)
    return summary.strip(), description.strip(), {n: " ".join(t.split()) for n, t in entries}


# Configuration


def _places(root: type) -> dict[type, list[str]]:
    """Dataclasses by where they stand in the configuration, the root first."""
    found: dict[type, list[str]] = {}
    waiting = [(root, "")]
    while waiting:
        cls, path = waiting.pop(0)
        found.setdefault(cls, [])
        if path in found[cls]:
            continue
        found[cls].append(path)
        hints = typing.get_type_hints(cls)
        for field in dataclasses.fields(cls):
            hint = hints[field.name]
            index = ".N" if typing.get_origin(hint) is tuple else ""
            place = f"{path}.{field.name}{index}".lstrip(".")
            waiting += [(k, place) for k in _leaves(hint) if dataclasses.is_dataclass(k)]
    return found


def _fields(cls: Any, paths: list[str]) -> str:
    hints = typing.get_type_hints(cls)
    rows = []
    for field in dataclasses.fields(cls):
        default, said = field.default, field.metadata["setting"]
        if dataclasses.is_dataclass(default):
            default = type(default).__name__
        shown = "required" if default is dataclasses.MISSING else f"`{default}`"
        kind = _cell(_type(hints[field.name]))
        row = [f"`{field.name}`", kind, shown, said.range, said.unit, _cell(said.meaning)]
        rows.append(f"| {' | '.join(row)} |")
    where = ", ".join(f"`{path}`" for path in paths if path) or "the root"
    summary = (inspect.getdoc(cls) or "").strip()
    if summary.startswith(f"{cls.__name__}("):  # dataclass writes one where there is none
        summary = ""
    table = [
        "| field | type | default | range | unit | meaning |",
        "|---|---|---|---|---|---|",
        *rows,
    ]
    parts = [f"## {cls.__name__}", f"At {where}.", summary, "\n".join(table) if rows else ""]
    return "\n\n".join(part for part in parts if part)


def _type(hint: Any) -> str:
    if (
        isinstance(hint, type)
        and hint is not type(None)
        and not isinstance(hint, types.GenericAlias)
    ):
        return f"`{hint.__name__}`"
    if _is_literal(hint):
        return ", ".join(f"`{choice}`" for choice in typing.get_args(hint))
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return " or ".join(
            _type(h) if h is not type(None) else "`None`" for h in typing.get_args(hint)
        )
    inner = ", ".join(
        "..." if h is ... else _type(h).replace("`", "") for h in typing.get_args(hint)
    )
    name = getattr(typing.get_origin(hint), "__name__", str(hint).replace("typing.", ""))
    return f"`{name}[{inner}]`" if inner else f"`{name}`"


# Ops


def _ops() -> dict[str, Any]:
    """Public names of univoxel.ops by kind: functions, then classes; no references."""
    import univoxel.ops
    import univoxel.optim

    names = [n for n in univoxel.ops.__all__ if not n.endswith(("_reference", "_reference_"))]
    found = {n: getattr(univoxel.ops, n) for n in names} | {"RowAdam": univoxel.optim.RowAdam}
    return dict(sorted(found.items(), key=lambda item: (inspect.isclass(item[1]), item[0].lower())))


def _summary(op: Any) -> str:
    return " ".join((inspect.getdoc(op) or "").partition("\n\n")[0].split())


def _op(name: str, op: Any) -> str:
    summary, _, rest = (inspect.getdoc(op) or "").partition("\n\n")
    parts = [f"## {name}", _escaped(" ".join(summary.split()))]
    parts.append(f"```python\n{_head(op)}\n```")
    if rest.strip():
        parts.append(f"```text\n{rest.rstrip()}\n```")
    if inspect.isclass(op):
        parts += [
            f"### {name}.{method}\n\n```python\n{_head(function)}\n```\n\n"
            f"```text\n{inspect.getdoc(function)}\n```"
            for method, function in vars(op).items()
            if inspect.isfunction(function) and not method.startswith("_") and function.__doc__
        ]
    return "\n\n".join(parts)


def _head(op: Any) -> str:
    """Source of a signature, with its comments; of a class its fields, or how it is made."""
    source = textwrap.dedent(inspect.getsource(op))
    node = ast.parse(source).body[0]
    assert isinstance(node, (ast.FunctionDef, ast.ClassDef))
    lines = source.splitlines()
    if isinstance(node, ast.FunctionDef):
        first = node.body[0].lineno - 1
        return "\n".join(lines[node.lineno - 1 : first])
    if not dataclasses.is_dataclass(op):
        made = next((n for n in node.body if getattr(n, "name", "") == "__init__"), None)
        if isinstance(made, ast.FunctionDef):
            head = "\n".join(lines[made.lineno - 1 : made.body[0].lineno - 1])
            return f"class {op.__name__}:\n{head}"
        return f"class {op.__name__}"
    kept = [lines[node.lineno - 1]]
    for inner in node.body:
        if isinstance(inner, ast.AnnAssign):
            kept += lines[inner.lineno - 1 : inner.end_lineno]
    return "\n".join(kept)


def _cell(text: str) -> str:
    """Text of a table's cell."""
    return _escaped(" ".join(text.split()))


def _escaped(text: str) -> str:
    """Bars and angles would end a cell or begin a tag; code spans keep their angles."""
    parts = re.split(r"(`[^`]*`)", text)
    plain = [p if p.startswith("`") else re.sub(r"([<>*])", r"\\\1", p) for p in parts]
    return "".join(plain).replace("|", "\\|")
