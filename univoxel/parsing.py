"""Arguments of the command line: which command is meant, what every command takes, completion."""

from __future__ import annotations

import contextlib
import difflib
import functools
import inspect
import io
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeAlias, Union, get_type_hints

import tyro
from tyro.conf import (
    ConsolidateSubcommandArgs,
    FlagCreatePairsOff,
    OmitArgPrefixes,
    OmitSubcommandPrefixes,
    arg,
    subcommand,
)

Command: TypeAlias = Callable[..., int | None]  # the exit code; None: 0
Shell: TypeAlias = Literal["bash", "zsh", "fish"]

LAB = "lab"  # the word before commands of the laboratory
WIDTH = 79  # of the overview


@dataclass(frozen=True)
class Common:
    quiet: bool = False
    """say nothing but results, warnings and errors"""
    verbose: bool = False
    """say more, with the seconds since the beginning, and where an error came from"""
    threads: Annotated[
        int | None, arg(metavar="N", help_behavior_hint="(default: one for each core)")
    ] = None
    """on which kernels and torch run"""


@dataclass(frozen=True)
class Call:
    """A command with its arguments."""

    name: str  # as it is written: "train", "lab chart"
    run: functools.partial[int | None]
    common: Common


class Usage(Exception):
    """Arguments that make no command; the message says what is wrong and where to look."""


def parse(
    arguments: Sequence[str], commands: Mapping[str, Command], prefix: str = ""
) -> Call | None:
    """The call that arguments ask for; None: help was asked for and printed.

    Args:
        commands: by name.
        prefix: what stands before their names.

    Raises:
        Usage: they make no command.
    """
    name, *rest = arguments
    if name not in commands:
        near = difflib.get_close_matches(name, commands, n=1)
        perhaps = f"; perhaps you meant {near[0]}" if near else ""
        raise Usage(f"no command {name!r}{perhaps}; see univoxel {prefix}--help")
    program, said = f"univoxel {prefix}{name}", io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            run, common = tyro.cli(
                deferred(commands[name]), prog=program, args=rest, config=(FlagCreatePairsOff,)
            )
    except SystemExit as end:
        if not end.code:
            return None
        raise Usage(f"{gist(said.getvalue())}; see {program} --help") from None
    if common.quiet and common.verbose:
        raise Usage(f"expected --quiet or --verbose, got both; see {program} --help")
    if common.threads is not None and common.threads < 1:
        raise Usage(f"--threads must be at least 1, got {common.threads}; see {program} --help")
    return Call(prefix + name, run, common)


def deferred(command: Command) -> Callable[..., tuple[functools.partial[int | None], Any]]:
    """A function of the same signature, and the common options, that returns the call."""

    def prepare(*args, common: Any, **kwargs):
        return functools.partial(command, *args, **kwargs), common

    hints = get_type_hints(command, include_extras=True)
    options = inspect.Parameter(
        "common",
        inspect.Parameter.KEYWORD_ONLY,
        default=Common(),
        annotation=Annotated[Common, OmitArgPrefixes],
    )
    signature = inspect.signature(command)
    own = [p.replace(annotation=hints[p.name]) for p in signature.parameters.values()]
    prepare.__signature__ = signature.replace(parameters=[*own, options])
    prepare.__annotations__ = hints | {"common": options.annotation}
    prepare.__doc__, prepare.__name__ = command.__doc__, command.__name__
    return prepare


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
            what = textwrap.shorten(what, WIDTH - width - 4, placeholder=" ...")
            lines.append(f"  {name:<{width}}  {what}")
    return "\n".join([*lines, end])


def completion(shell: Shell, commands: Mapping[str, Command], lab: Mapping[str, Command]) -> str:
    """The script that makes a shell complete commands, options and their choices.

    Args:
        lab: commands of the laboratory; none where it is not there.
    """

    def laboratory(command):
        """Commands of the laboratory."""

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
    kinds = [
        Annotated[Any, subcommand(name, constructor=command if name == LAB else deferred(command))]
        for name, command in commands.items()
    ]
    return Union[tuple(kinds)]  # noqa: UP007
