"""The command line: parse arguments, run one command, print a mistake of the user in one line.

Each command is a file with a record of its options and a function. The files import torch inside
functions only, so that `univoxel --help` does not wait for it.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import logging
import os
import re
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

from univoxel import __version__
from univoxel.cli import (
    batch,
    capture,
    cutout,
    demo,
    detail,
    doctor,
    envmap,
    evaluate,
    export,
    info,
    inspect,
    parsing,
    poses,
    relight,
    report,
    train,
    view,
)
from univoxel.cli.parsing import LAB, STDOUT, Call, Command, Common, Shell, Usage
from univoxel.core import log, machine, system
from univoxel.errors import MissingExtra, UserError

# What a command may raise for a mistake of its user, see `is_mistake`; all else is a bug and keeps
# its traceback
MISTAKES = (UserError, OSError, MemoryError)
# Of files and disks of the user, whether or not the error names the file
DISK = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO}
PACKAGE = Path(__file__).resolve().parents[1]
CLONE = PACKAGE.parent  # of the repository, where the package is in one
# Options whose names differ from the arguments of the package's functions
OPTIONS = {"changes": "--set", "source": "--from"}

# Turns that a thread waits before it leaves its core to other programs. By default it waits for
# so long that a training beside one other program took six times as long (lab/notes/speed.md)
SPINS = "3000"


def completion(
    shell: Annotated[Shell, parsing.written("bash|zsh|fish", positional=True)], /
) -> None:
    """Print a shell completion script.

    For bash, add this line to ~/.bashrc: eval "$(univoxel completion bash)"

    Args:
        shell: your shell
    """
    lab = laboratory() if has_laboratory() else {}
    print(parsing.completion(shell, COMMANDS, lab), end="")


COMMANDS: dict[str, Command] = {
    "capture": capture.command,
    "poses": poses.command,
    "cutout": cutout.command,
    "train": train.command,
    "batch": batch.command,
    "eval": evaluate.command,
    "relight": relight.command,
    "export": export.command,
    "view": view.command,
    "report": report.command,
    "detail": detail.command,
    "envmap": envmap.command,
    "inspect": inspect.command,
    "info": info.command,
    "demo": demo.command,
    "doctor": doctor.command,
    "completion": completion,
}

# Written `univoxel lab NAME`; without the word, as they once were, they work too
LABORATORY = ("compare", "chart", "stress", "bank", "submit", "published")


def has_laboratory() -> bool:
    """Whether the package is in a clone, beside the folder `lab`, which no wheel holds."""
    return (CLONE / "lab" / "commands.py").is_file()


def laboratory() -> dict[str, Command]:
    """Commands of the experiments by name; a MissingExtra if there is none beside the package."""
    if not has_laboratory():
        raise MissingExtra(
            f"{', '.join(LABORATORY)} run experiments, which are not in the installed package: "
            "clone the repository, run `make dev` there, and use .venv/bin/univoxel lab"
        )
    return importlib.import_module("lab.commands").COMMANDS


def main(argv: list[str] | None = None) -> int:
    """Run one command; returns the exit code.

    0: success; 1: the reader of the output closed it; 2: a mistake of the user; 3: a stage of a
    training made no step; 130: interrupted.

    The hidden flag --traceback shows where an error came from.
    """
    if "OMP_WAIT_POLICY" not in os.environ:  # read when a command imports torch
        os.environ.setdefault("GOMP_SPINCOUNT", SPINS)
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        code = _run(arguments)
        sys.stdout.flush()
    except BrokenPipeError:  # such as `univoxel --help | head`
        # Python flushes once more at its end: into nothing
        with contextlib.suppress(OSError, ValueError):  # a stand-in for stdout has no descriptor
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return code


def _run(arguments: list[str]) -> int:
    """`main` with its surroundings prepared."""
    if arguments == ["--version"]:
        print(f"univoxel {__version__}")
        return 0
    if sorted(arguments) == ["--verbose", "--version"]:
        arguments = ["doctor"]
    traceback = "--traceback" in arguments
    arguments = [a for a in arguments if a != "--traceback"]
    if (wrong := unusable(arguments)) is not None:
        print(f"univoxel: {wrong}; see univoxel --help", file=sys.stderr)
        return 2
    # Parse alone first: what a command raises must not pass for an error of its arguments.
    try:
        if (screen := help_screen(arguments)) is not None:
            print(screen)
            return 0
        call = understood(arguments)
    except (Usage, MissingExtra) as wrong:
        print(f"univoxel: {wrong}", file=sys.stderr)
        return 2
    if call is None:
        return 0
    take_threads(call.common.threads, elsewhere=call.name == "batch")
    try:
        with spoken(call.common, results_alone=call.run.keywords.get("json") == STDOUT):
            return shown(call.run())
    except KeyboardInterrupt:
        print(f"univoxel {call.name}: interrupted{_kept(call)}", file=sys.stderr)
        return 130
    except (*MISTAKES, RuntimeError) as error:
        if traceback or call.common.verbose or not is_mistake(error):
            raise
        message = " ".join(str(error).split()) or type(error).__name__
        if isinstance(error, UserError):
            message = with_options(message, error.arguments)
        message = message.removeprefix(f"{call.name.split()[-1]}: ")
        print(f"univoxel {call.name}: {message}", file=sys.stderr)
        return 2


def shown(result: parsing.Result) -> int:
    """Print the files that a command made; return its exit code."""
    if isinstance(result, int):
        return result
    for path in [result] if isinstance(result, Path) else result or ():
        print(path)
    return 0


def understood(arguments: Sequence[str]) -> Call | None:
    """The call that arguments ask for; None: help was asked for and printed. Raises Usage if they
    make no command, and errors of `laboratory`."""
    match arguments:
        case [name, *_] if name in LABORATORY:
            return parsing.parse(arguments, laboratory(), f"{LAB} ")
        case [word, *rest] if word == LAB:
            return parsing.parse(rest, laboratory(), f"{LAB} ")
    return parsing.parse(arguments, COMMANDS)


def help_screen(arguments: Sequence[str]) -> str | None:
    """The overview that arguments ask for; None: they ask for something else. Errors are those of
    `laboratory`."""
    match arguments:
        case [] | ["-h" | "--help" | "help"]:
            title = f"univoxel {__version__}: from photographs to a relightable object, on any CPU"
            return parsing.overview(
                title, groups(), "For the options of a command, run univoxel COMMAND --help."
            )
        case ["lab"] | ["lab", "-h" | "--help" | "help"]:
            end = f"For the options of a command, run univoxel {LAB} COMMAND --help."
            return parsing.overview("Experiments", {f"univoxel {LAB}": laboratory()}, end)
    return None


def groups() -> dict[str, dict[str, Command]]:
    """Commands in the order of work; those in no group are commands on a run."""
    first = ("capture", "poses", "cutout", "train", "batch")
    last = ("demo", "doctor", "completion")
    run = [name for name in COMMANDS if name not in first + last]
    named = {"Make a run": first, "Use a run": run, "Other commands": last}
    found = {g: {n: COMMANDS[n] for n in names} for g, names in named.items()}
    found["Other commands"][LAB] = lab
    return found


def lab() -> None:
    """Run experiments, in a clone of the repository."""


def take_threads(threads: int | None, elsewhere: bool = False) -> None:
    """Set the number of threads of kernels, torch and child processes.

    None: OMP_NUM_THREADS, or else one per core. If a control group grants fewer cores, as in a
    container, OpenMP does not see it, and the surplus threads would wait. So would those of a
    number beyond the cores, of which torch leaves out the surplus only where it has MKL. With
    `elsewhere` the number is of processes on other machines, which may have more cores.
    """
    if threads is not None:
        threads = threads if elsewhere else min(threads, system.usable_cores())
    else:
        granted = machine.cores()
        if "OMP_NUM_THREADS" in os.environ or granted >= system.usable_cores():
            return
        threads = max(int(granted), 1)
    os.environ["OMP_NUM_THREADS"] = str(threads)  # read when a command imports torch
    if (torch := sys.modules.get("torch")) is not None:
        torch.set_num_threads(threads)


def unusable(arguments: Sequence[str]) -> str | None:
    """What is wrong with arguments that no command can use; None: nothing.

    An empty path would be the present folder. Names that are not UTF-8 can be made, but the formats
    of files cannot hold them, nor every library open them.
    """
    for argument in arguments:
        if not argument or re.fullmatch(r"--[\w-]+=", argument):
            return f"expected no empty arguments, got {argument!r}"
        try:
            argument.encode()
        except UnicodeEncodeError:
            return f"expected arguments in UTF-8, got {os.fsencode(argument)!r}"
    return None


def is_mistake(error: Exception) -> bool:
    """Whether an exception is a mistake of the user, or something that the machine lacks."""
    match error:
        case BrokenPipeError():
            return False
        case UserError() | MemoryError():
            return True
        case OSError(filename=str() | bytes() | os.PathLike()):  # of the user, not one of ours
            return PACKAGE not in Path(os.fsdecode(error.filename)).absolute().parents
        case OSError():
            return error.errno in DISK
        case RuntimeError():
            return "can't allocate memory" in str(error)  # as torch says it
    return False


def with_options(message: str, arguments: Sequence[str]) -> str:
    """A message of the package in which options of the command line stand for arguments.

    `name=value` becomes `--name value`; otherwise the first mention of the name becomes `--name`.
    """
    for name in arguments:
        option = OPTIONS.get(name, "--" + name.replace("_", "-"))
        word = rf"(?<![\w-]){name}"
        if re.search(rf"{word}=", message):
            message = re.sub(rf"{word}=", f"{option} ", message)
        else:
            message = re.sub(rf"{word}(?![\w-])", option, message, count=1)
    return message


class _Plain(logging.Handler):
    """Prints what the package says, as it is; progress on stderr."""

    def __init__(self, common: Common, results_alone: bool) -> None:
        super().__init__()
        self._begin = time.monotonic() if common.verbose else None
        self._results_alone = results_alone

    def emit(self, record: logging.LogRecord) -> None:
        said = with_options(record.getMessage(), getattr(record, "arguments", ()))
        if self._begin is not None:
            said = f"{time.monotonic() - self._begin:7.1f} s  {said}"
        aside = self._results_alone or getattr(record, "progress", False)
        print(said, file=sys.stderr if aside else sys.stdout, flush=True)


@contextlib.contextmanager
def spoken(common: Common, results_alone: bool) -> Iterator[None]:
    """Print what the package logs while a command runs; on stderr, if results stand alone on
    stdout."""
    handler, level = _Plain(common, results_alone), log.level
    log.addHandler(handler)
    chosen = logging.WARNING if common.quiet else logging.DEBUG if common.verbose else logging.INFO
    log.setLevel(chosen)
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.setLevel(level)


def _kept(call: Call) -> str:
    """What an interrupted command left behind."""
    out = call.run.keywords.get("out")
    if call.name in ("batch", "lab compare", "lab chart", "lab stress"):
        return f"; finished runs are in {out}: run the same command again to resume"
    if call.name in ("capture", "poses"):
        return f"; finished steps are in {out}: run the same command again to resume"
    if call.name != "train" or not isinstance(out, Path):
        return ""
    if (out / "scene.safetensors").exists():
        return f"; the last saved state is in {out}: continue with --resume"
    return f"; nothing was saved in {out} yet"
