"""The page of the Python package, from signatures and docstrings of its public names."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
import textwrap
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from doc_reference import _cell, _escaped, _type

SECTION = re.compile(r"^(Args|Attributes|Returns|Raises):\n((?:    .*\n?|\n)*)", re.MULTILINE)
ENTRY = re.compile(r"^    ([\w, ]+): (.*(?:\n     .*)*)", re.MULTILINE)
COLUMNS = 88


def python() -> str:
    """Functions, the run, what they return and raise, and the options that they take."""
    import univoxel
    from univoxel import run
    from univoxel.cli.capture import Captured

    names = {name: getattr(univoxel, name) for name in univoxel.__all__}
    functions = {n: f for n, f in names.items() if inspect.isfunction(f)}
    records = (univoxel.TrainingProgress, run.Verdict, run.Evidence, Captured)
    parts = ["## Functions", *(_function(f"univoxel.{n}", f) for n, f in functions.items())]
    parts += ["## Run", _run(univoxel.Run), "## Records"]
    parts += [_fields(c) for c in records]
    parts += ["## Errors", _errors(), "## Options"]
    parts += [_options(name, record) for name, record in _records().items()]
    return "\n\n".join(parts)


GENERATORS: dict[str, Callable[[], str]] = {"python": python}


def _records() -> dict[str, type]:
    """Records of options by the functions that take their fields."""
    from univoxel.cli.capture import CaptureOptions
    from univoxel.cli.relight import RelightOptions
    from univoxel.cli.train import TrainOptions
    from univoxel.output.page import PageOptions
    from univoxel.output.report import ReportOptions

    return {
        "univoxel.train": TrainOptions,
        "univoxel.capture_object": CaptureOptions,
        "univoxel.relight and Run.relight": RelightOptions,
        "Run.page": PageOptions,
        "Run.report": ReportOptions,
    }


def _run(run: type) -> str:
    """The class, its properties and its methods."""
    sections, summary = _sections(run)
    parts = [summary]
    rows = {name: text for name, text in sections.get("Attributes", {}).items()}
    own = {n: v for n, v in vars(run).items() if not n.startswith("_") and v.__doc__}
    for name, value in own.items():
        if isinstance(value, property):
            rows[name] = " ".join((inspect.getdoc(value) or "").split())
    parts.append(_table(("attribute", "meaning"), [(f"`{n}`", _cell(t)) for n, t in rows.items()]))
    methods = {n: v for n, v in own.items() if inspect.isfunction(v)}
    parts += [_function(f"Run.{name}", method) for name, method in methods.items()]
    return "\n\n".join(parts)


def _function(name: str, function: Any) -> str:
    """Signature, what it does, arguments, what it returns and raises."""
    from univoxel.cli.parsing import meanings

    sections, summary = _sections(function)
    record = getattr(function, "record", None)
    said = meanings(record) if record else sections.get("Args", {})
    parts = [f"### {name}", f"```python\n{_signature(name, function)}\n```", summary]
    if said:
        rows = [(f"`{n}`", _cell(text)) for n, text in said.items()]
        parts.append(_table(("argument", "meaning"), rows))
    if returns := sections.get("Returns"):
        parts.append(f"**Returns:** {_escaped(returns[''])}")
    if raises := sections.get("Raises"):
        rows = [(f"`{n}`", _cell(text)) for n, text in raises.items()]
        parts.append(_table(("raises", "if"), rows))
    return "\n\n".join(part for part in parts if part)


def _sections(documented: Any) -> tuple[dict[str, dict[str, str]], str]:
    """Entries of a docstring by section and name, and the text before them.

    What a section says without naming anything has the name "".
    """
    doc = inspect.getdoc(documented) or ""
    found = {}
    for match in SECTION.finditer(doc + "\n"):
        entries = {n: " ".join(t.split()) for n, t in ENTRY.findall(match[2])}
        if match[1] == "Returns":
            entries = {"": " ".join(match[2].split())}
        found[match[1]] = entries
    text = SECTION.sub("", doc + "\n").strip()
    paragraphs = [" ".join(p.split()) for p in text.split("\n\n")]
    return found, "\n\n".join(_escaped(p) for p in paragraphs)


def _signature(name: str, function: Any) -> str:
    """The call, on one line or with a line for each argument."""
    from univoxel.cli.parsing import hints_of

    hints = hints_of(function) if hasattr(function, "record") else {}
    shown, before = [], None
    for p in inspect.signature(function).parameters.values():
        if p.name == "self":
            continue
        if p.kind is p.KEYWORD_ONLY and before not in (p.KEYWORD_ONLY, p.VAR_POSITIONAL):
            shown.append("*")
        if before is p.POSITIONAL_ONLY and p.kind is not p.POSITIONAL_ONLY:
            shown.append("/")
        before = p.kind
        shown.append(_parameter(p, hints))
    result = str(inspect.signature(function).return_annotation).strip("'")
    head = f"def {name.rpartition('.')[2]}"
    line = f"{head}({', '.join(shown)}) -> {result}"
    if len(line) <= COLUMNS:
        return line
    return f"{head}(\n" + "".join(f"    {text},\n" for text in shown) + f") -> {result}"


def _parameter(parameter: inspect.Parameter, hints: Mapping[str, Any]) -> str:
    if parameter.kind is parameter.VAR_KEYWORD:
        return f"**{parameter.name}"
    hint = hints.get(parameter.name)
    kind = parameter.annotation if hint is None else _plain(hint)
    text = f"{parameter.name}: {kind}"
    return text if parameter.default is parameter.empty else f"{text} = {_value(parameter.default)}"


def _plain(hint: Any) -> str:
    """A type as it is written, without what is said of it for the command line."""
    if hasattr(hint, "__metadata__"):
        hint = typing.get_args(hint)[0]
    if typing.get_origin(hint) is typing.Literal:
        return f"Literal[{', '.join(_value(choice) for choice in typing.get_args(hint))}]"
    return _type(hint).replace("`", "").replace(" or ", " | ")


def _value(value: Any) -> str:
    """A default: of a record only its name, of a path its text."""
    if dataclasses.is_dataclass(value):
        return f"{type(value).__name__}()"
    return f'"{value}"' if isinstance(value, (str, Path)) else repr(value)


def _options(name: str, record: Any) -> str:
    """A table of the fields of a record."""
    kinds = _kinds(record)
    rows = [
        (f"`{field.name}`", kinds[field.name], _default(field), _cell(text))
        for field, text in _said(record)
        if "Callable" not in kinds[field.name]  # what the package fills in
        and (field.default, field.default_factory) != (dataclasses.MISSING, dataclasses.MISSING)
    ]
    where = f"`{record.__module__}.{record.__name__}`"
    table = _table(("option", "values", "default", "meaning"), rows)
    return f"### Options of {name}\n\nThe fields of {where}.\n\n{table}"


def _fields(record: Any) -> str:
    """A record that is returned: its fields."""
    _, summary = _sections(record)
    kinds = _kinds(record)
    rows = [(f"`{field.name}`", kinds[field.name], _cell(text)) for field, text in _said(record)]
    head = f"### {record.__module__}.{record.__name__}"
    return f"{head}\n\n{summary}\n\n{_table(('field', 'type', 'meaning'), rows)}"


def _kinds(record: Any) -> dict[str, str]:
    """Types of the fields of a record, or the values that they may have, as cells."""
    hints = typing.get_type_hints(record, include_extras=True)
    plain = {name: _plain(hint) for name, hint in hints.items()}
    return {name: f"`{_in_cell(text)}`" for name, text in plain.items()}


def _in_cell(text: str) -> str:
    """Choices as they are given, and bars that do not end the cell."""
    return re.sub(r"Literal\[(.*?)\]", r"\1", text).replace("|", "\\|")


def _said(record: Any) -> list[tuple[dataclasses.Field, str]]:
    """Fields of a record with what is said of each: a text below it, or a comment beside it."""
    from univoxel.cli.parsing import meanings

    below = meanings(record)
    source = textwrap.dedent(inspect.getsource(record))
    lines, body = source.splitlines(), ast.parse(source).body[0]
    assert isinstance(body, ast.ClassDef)
    beside = {}
    for node in body.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            _, _, comment = lines[(node.end_lineno or node.lineno) - 1].partition("  # ")
            beside[node.target.id] = comment
    return [(f, below.get(f.name) or beside.get(f.name, "")) for f in dataclasses.fields(record)]


def _default(field: dataclasses.Field) -> str:
    if field.default is not dataclasses.MISSING:
        return f"`{_value(field.default)}`"
    return "`{}`"


def _errors() -> str:
    """Every exception of the package with what it is for."""
    from univoxel import errors

    own = [
        c for c in vars(errors).values() if inspect.isclass(c) and c.__module__ == errors.__name__
    ]
    rows = []
    for kind in own:
        bases = ", ".join(f"`{base.__name__}`" for base in kind.__bases__)
        rows.append((f"`{kind.__name__}`", bases, _cell(_sections(kind)[1].partition("\n\n")[0])))
    return f"In `{errors.__name__}`.\n\n{_table(('error', 'is a', 'meaning'), rows)}"


def _table(heads: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [f"| {' | '.join(heads)} |", f"|{'|'.join('---' for _ in heads)}|"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])
