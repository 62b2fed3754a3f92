"""Arguments of the command line: commands, options, help and shell completion.

The options of a command are a record; the docstring under a field is its help.
"""

from __future__ import annotations

import ast
import contextlib
import difflib
import functools
import inspect
import io
import itertools
import re
import sys
import tempfile
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import (
    Annotated,
    Any,
    Literal,
    ParamSpec,
    TypeAlias,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from univoxel.core.choices import Box, Downscale
from univoxel.errors import demand

# What a command returns is printed, if it is a file or several; a number is the exit code
Result: TypeAlias = int | Path | Sequence[Path] | None
Command: TypeAlias = Callable[..., Result]
Shell: TypeAlias = Literal["bash", "zsh", "fish"]

LAB = "lab"  # the word before commands of the experiments
WIDTH, COLUMN = 100, 22  # of help, and where texts begin in it
GROUPED = 12  # arguments; commands with more list the advanced ones apart
UNSAID = {"default: None", "default: False", "default: ", "default: none", "repeatable"}


@dataclass(frozen=True)
class Written:
    """How an option is written, and shown in help."""

    metavar: str | None = None  # what it takes
    hint: str | None = None  # what help says of its default
    name: str | None = None  # without dashes, if it is not the field's
    positional: bool = False
    repeatable: bool = False
    advanced: bool = False  # help lists it after the others


def written(metavar: str | None = None, default: str | None = None, **other: Any) -> Written:
    """The same with a default in words."""
    hint = {} if default is None else {"hint": f"(default: {default})"}
    return Written(metavar, **hint, **other)


ADVANCED = Written(advanced=True)

# Options of several commands
File: TypeAlias = Path | str  # text in the library only: the command line makes paths
Run: TypeAlias = Annotated[File, written("RUN", positional=True)]
AtOnce: TypeAlias = Annotated[int, written("N")]
Scheduler: TypeAlias = Annotated[str | None, written("ADDRESS", "this machine", advanced=True)]
Scenes: TypeAlias = Annotated[
    tuple[Path, ...], Written("SCENE [SCENE ...]", "(required)", positional=True)
]
Changes: TypeAlias = Annotated[
    tuple[str, ...], Written("FIELD=VALUE", "(repeatable)", "set", repeatable=True, advanced=True)
]
Minutes: TypeAlias = Annotated[float | None, written("MINUTES", "none")]
ConfigFile: TypeAlias = Annotated[Path | None, written("FILE", "from --preset", advanced=True)]
JsonFile: TypeAlias = Annotated[File | None, written("FILE|-", "none")]
LightOf: TypeAlias = Annotated[str | None, written("VIEW", "the mean of all views", advanced=True)]

DataOf: TypeAlias = Annotated[File | None, written("DATA", "the folder trained on")]
Title: TypeAlias = Annotated[str | None, written("TEXT", "the folder's name")]
BoxOf: TypeAlias = Annotated[Box | None, written("X0 Y0 Z0 X1 Y1 Z1", "none", advanced=True)]
DownscaleBy: TypeAlias = Annotated[Downscale, written("auto|N")]

STDOUT = Path("-")  # as a file for JSON: print it, and it alone

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")


@dataclass(frozen=True)
class Common:
    quiet: bool = False
    """print only results, warnings and errors"""
    verbose: bool = False
    """print details, elapsed seconds and tracebacks of errors"""
    threads: Annotated[int | None, written("N", "one per core")] = None
    """number of threads, at most one per core"""


@dataclass(frozen=True)
class Call:
    """A command with its arguments."""

    name: str  # as it is written: "train", "lab chart"
    run: functools.partial[Result]
    common: Common


class Usage(Exception):
    """Arguments that make no command; the message says what is wrong and where to look."""


def parse(
    arguments: Sequence[str], commands: Mapping[str, Command], prefix: str = ""
) -> Call | None:
    """The call that arguments ask for; None: help was asked for and printed.

    Args:
        commands: by name, without the prefix.

    Raises:
        Usage: they make no command.
    """
    name, *rest = arguments
    if name not in commands:
        near = difflib.get_close_matches(name, commands, n=1)
        perhaps = f"; perhaps you meant {near[0]}" if near else ""
        raise Usage(f"no command {name!r}{perhaps}; see univoxel {prefix}--help")
    program, said = f"univoxel {prefix}{name}", io.StringIO()
    if {"-h", "--help"} & set(rest):
        print(help_of(program, commands[name]))
        return None
    import tyro

    try:
        with contextlib.redirect_stderr(said):
            run, common = tyro.cli(
                deferred(commands[name]),
                prog=program,
                args=rest,
                config=(tyro.conf.FlagCreatePairsOff,),
            )
    except SystemExit:
        wrong = gist(said.getvalue())
        if wrong.startswith("Missing from "):
            wrong = f"expected {usage(program, commands[name])}"
        raise Usage(f"{wrong}; see {program} --help") from None
    if common.quiet and common.verbose:
        raise Usage(f"expected --quiet or --verbose, got both; see {program} --help")
    if common.threads is not None and common.threads < 1:
        raise Usage(f"--threads must be at least 1, got {common.threads}; see {program} --help")
    return Call(prefix + name, run, common)


def takes(
    record: Callable[P, R], gradients: bool = True
) -> Callable[[Callable[[R], T]], Callable[P, T]]:
    """Make a function of a record one of the record's fields, so that options stand once.

    Commands and functions of the library are such functions.

    Args:
        gradients: whether torch keeps track of what they would need.
    """

    def made(function: Callable[[R], T]) -> Callable[P, T]:
        @functools.wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> T:
            asked = record(*args, **kwargs)
            if gradients:
                return function(asked)
            import torch

            with torch.no_grad():
                return function(asked)

        result = function.__annotations__.get("return")
        signature = inspect.signature(record).replace(return_annotation=result)
        vars(call).update(__signature__=signature, record=record)
        return call

    return made


def hints_of(command: Command) -> dict[str, Any]:
    """Types of a command's arguments, with what is said of them; only now, as it takes a while."""
    return get_type_hints(getattr(command, "record", command), include_extras=True)


def documentation(command: Command) -> str:
    """What a command does, and under Args what its arguments mean: what its record says of them."""
    text = inspect.getdoc(command) or ""
    if (record := getattr(command, "record", None)) is None:
        return text
    what = re.split(r"\n\n(?:Returns|Raises):\n", text)[0]
    return "\n".join([what, "", "Args:", *(f"    {n}: {m}" for n, m in meanings(record).items())])


def meanings(record: type) -> dict[str, str]:
    """What is under each field of a record, in one line; nothing if there is no source. A record is
    in one file with its bases."""
    try:
        tree = ast.parse(inspect.getsource(sys.modules[record.__module__]))
    except OSError:
        return {}
    bodies = {node.name: node.body for node in tree.body if isinstance(node, ast.ClassDef)}
    found = {}
    for kind in record.__mro__[-2::-1]:  # bases first, as their fields are
        for pair in itertools.pairwise(bodies[kind.__name__]):
            match pair:
                case ast.AnnAssign(ast.Name(name)), ast.Expr(ast.Constant(str(text))):
                    found[name] = " ".join(text.split())
    return found


def deferred(command: Command) -> Callable[..., tuple[functools.partial[Result], Any]]:
    """A function of the same signature, and the common options, that returns the call."""

    def prepare(*args, quiet: bool, verbose: bool, threads: int | None, **kwargs):
        return functools.partial(command, *args, **kwargs), Common(quiet, verbose, threads)

    common = [
        p.replace(kind=inspect.Parameter.KEYWORD_ONLY)
        for p in inspect.signature(Common).parameters.values()
    ]
    hints = hints_of(command) | get_type_hints(Common, include_extras=True)
    hints = {name: _for_tyro(hint) for name, hint in hints.items()}
    signature = inspect.signature(command)
    every = [*signature.parameters.values(), *common]
    every = [p.replace(annotation=hints[p.name]) for p in every]
    prepare.__signature__ = signature.replace(parameters=every)
    prepare.__annotations__ = hints
    said = (f"    {name}: {text}" for name, text in meanings(Common).items())
    prepare.__doc__, prepare.__name__ = "\n".join([documentation(command), *said]), "command"
    return prepare


def shown(name: str, hint: Any) -> tuple[Written, str, str]:
    """How an argument is marked; its flag, empty if it has none; and the values it takes."""
    found = [mark for mark in getattr(hint, "__metadata__", ()) if isinstance(mark, Written)]
    mark, kind = found[0] if found else Written(), hint
    while get_origin(kind) is not Literal and get_args(kind):
        kind = get_args(kind)[0]
    names = {bool: "", int: "N", float: "NUMBER"}
    values = mark.metavar or "|".join(map(str, get_args(kind))) or names.get(kind, "TEXT")
    return mark, "" if mark.positional else "--" + (mark.name or name).replace("_", "-"), values


def usage(program: str, command: Command) -> str:
    """A command with the arguments that it requires."""
    required = [p for p in inspect.signature(command).parameters.values() if p.default is p.empty]
    parts = [shown(p.name, hints_of(command)[p.name])[1:] for p in required]
    return " ".join([program, *(part for pair in parts for part in pair if part)])


def help_of(program: str, command: Command) -> str:
    """The text that `--help` prints: usage, description, and arguments in groups."""
    told = deferred(command)
    what, _, listed = (told.__doc__ or "").partition("\n\nArgs:\n")
    texts = dict(re.findall(r"^    (\w+): (.*(?:\n     .*)*)", listed, re.MULTILINE))
    hints = hints_of(command) | get_type_hints(Common, include_extras=True)
    parameters = inspect.signature(told).parameters.values()
    names = "arguments", "options", "advanced options", "common options"
    groups: dict[str, list[str]] = {name: [] for name in names}
    for p in parameters:
        mark, flag, values = shown(p.name, hints[p.name])
        grouped = mark.advanced and len(parameters) > GROUPED
        group = names[3 if p.name in Common.__annotations__ else 2 if grouped else 1 if flag else 0]
        value = " ".join(p.default) if isinstance(p.default, tuple) else p.default
        hint = mark.hint or ("(required)" if value is p.empty else f"(default: {value})")
        if not flag or hint.strip("()") in UNSAID:
            hint = ""
        first = f"  {flag} {values}".rstrip() if flag else f"  {values}"
        lines = textwrap.wrap(f"{texts[p.name]} {hint}", WIDTH - COLUMN, break_on_hyphens=False)
        lines.insert(0, first if len(first) + 2 > COLUMN else first.ljust(COLUMN) + lines.pop(0))
        groups[group].append(f"\n{'':{COLUMN}}".join(lines))
    parts = [f"usage: {usage(program, command)} [OPTIONS]", what]
    parts += ["\n".join([f"{name}:", *rows]) for name, rows in groups.items() if rows]
    return "\n\n".join(parts)


def _for_tyro(hint: Any) -> Any:
    """A type with how it is written, as tyro is told it."""
    from tyro.conf import Positional, UseAppendAction, arg

    if (mark := shown("", hint)[0]) == Written():
        return hint
    kind = get_args(hint)[0]
    if mark.positional:
        kind = Positional[kind]
    if mark.repeatable:
        kind = UseAppendAction[kind]
    return Annotated[kind, arg(name=mark.name, metavar=mark.metavar, help_behavior_hint=mark.hint)]


def gist(box: str) -> str:
    """The message on one line, with what tyro thinks was meant, of the box that it draws.

    The box has a title, the message and hints, with rules between them.
    """
    lines = [line.strip("│╰╯ ") for line in box.splitlines()][1:]
    ruled = [bool(line) and not line.strip("─-") for line in lines]
    begin = ruled[:1] == [True]  # without UTF-8 there is a rule under the title
    message = lines[begin : ruled.index(True, begin)] if True in ruled[begin:] else lines
    meant = re.search(r"Perhaps you meant:\s+(--[\w-]+)", "\n".join(lines))
    perhaps = f"; perhaps you meant {meant[1]}" if meant else ""
    return " ".join(" ".join(message).split()).rstrip(".") + perhaps


def overview(title: str, groups: Mapping[str, Mapping[str, Command]], end: str) -> str:
    """One screen: groups of commands, each with the first line of what it does."""
    width = max(len(name) for group in groups.values() for name in group)
    lines = [title]
    for group, commands in groups.items():
        lines.append(f"{group}:")
        for name, command in commands.items():
            what = (inspect.getdoc(command) or "").partition("\n")[0].rstrip(".")
            lines.append(f"  {name:<{width}}  {what}")
    return "\n".join([*lines, end])


def completion(shell: Shell, commands: Mapping[str, Command], lab: Mapping[str, Command]) -> str:
    """The script that makes a shell complete commands, those of the experiments if there are any,
    options and their choices."""

    import tyro
    from tyro.conf import ConsolidateSubcommandArgs, FlagCreatePairsOff, OmitSubcommandPrefixes

    def laboratory(command):
        """Commands of the experiments."""

    if lab:
        laboratory.__annotations__["command"] = Annotated[_union(lab), OmitSubcommandPrefixes]
        commands = {**commands, LAB: laboratory}
    said = io.StringIO()
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(said):
        tyro.cli(
            _union(commands),
            prog="univoxel",
            args=["--tyro-write-completion", shell, "-"],
            config=(FlagCreatePairsOff, ConsolidateSubcommandArgs),
        )
    # Names of files where nothing else fits, as zsh and fish do
    return said.getvalue().replace("complete -F ", "complete -o default -F ")


def _union(commands: Mapping[str, Command]) -> Any:
    """A type whose values are commands, for tyro."""
    from tyro.conf import subcommand

    kinds = [
        Annotated[Any, subcommand(name, constructor=command if name == LAB else deferred(command))]
        for name, command in commands.items()
    ]
    return Union[tuple(kinds)]  # noqa: UP007


@contextlib.contextmanager
def json_file(asked: File | None) -> Iterator[File | None]:
    """The file for a task to write; what was asked to be printed is, at the end."""
    if asked != STDOUT:
        yield asked
        return
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "printed.json"
        yield file
        print(file.read_text(encoding="utf-8"), end="")


def check_minutes(minutes: float | None) -> None:
    """Refuse, by a UserError, a limit that is not above 0."""
    demand(minutes is None or minutes > 0, "minutes", "above 0", minutes)


def check_downscale(downscale: Downscale) -> int:
    """The side of the squares of pixels that become one, 0 for auto; a UserError below 1."""
    if downscale == "auto":
        return 0
    demand(downscale >= 1, "downscale", "at least 1", downscale)
    return downscale
