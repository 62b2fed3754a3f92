"""The command line: parse, run one command, turn a user's mistake into one line."""

from __future__ import annotations

import contextlib
import errno
import functools
import io
import logging
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import tyro
from tyro.conf import FlagCreatePairsOff

from univoxel import __version__
from univoxel.commands import COMMANDS, capture, chart, compare, poses, stress, train
from univoxel.errors import UserError

# What a command may raise for a mistake of its user, see `is_mistake`; all else is a bug and keeps
# its traceback
MISTAKES = (UserError, OSError, MemoryError)
# Of files and disks of the user, whether or not the error names the file
DISK = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO}
PACKAGE = Path(__file__).resolve().parent
# Options whose names differ from the arguments of the package's functions
OPTIONS = {"changes": "--set", "source": "--from"}

# Turns that a thread waits before it leaves its core to other programs. By default it waits for
# so long that a training beside one other program took six times as long (docs/research/speed.md)
SPINS = "3000"


def main(argv: list[str] | None = None) -> int:
    """Run one command; returns the exit code.

    0; 1 where nobody reads the output to its end; 2 for a user's mistake; 130 when interrupted.

    The hidden flag --traceback shows where an error came from.
    """
    if "OMP_WAIT_POLICY" not in os.environ:  # read when a command imports torch
        os.environ.setdefault("GOMP_SPINCOUNT", SPINS)
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        with spoken():
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
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            call = tyro.extras.subcommand_cli_from_dict(
                {name: _deferred(command) for name, command in COMMANDS.items()},
                prog="univoxel",
                description="From posed photographs to a relightable object, on a plain CPU.",
                args=arguments,
                config=(FlagCreatePairsOff,),
            )
    except SystemExit as end:
        if end.code:
            print(f"univoxel: {_gist(said.getvalue())}; see univoxel --help", file=sys.stderr)
            return 2
        return 0
    try:
        call()
    except KeyboardInterrupt:
        print(f"univoxel {arguments[0]}: interrupted{_kept(call)}", file=sys.stderr)
        return 130
    except (*MISTAKES, RuntimeError) as error:
        if traceback or not is_mistake(error):
            raise
        message = " ".join(str(error).split()) or type(error).__name__
        if isinstance(error, UserError):
            message = with_options(message, error.arguments)
        message = message.removeprefix(f"{arguments[0]}: ")
        print(f"univoxel {arguments[0]}: {message}", file=sys.stderr)
        return 2
    return 0


def unusable(arguments: Sequence[str]) -> str | None:
    """What is wrong with arguments that no command can use; None: nothing.

    An empty path would be the present folder. Names that are not UTF-8 can be made, but the formats
    of files cannot hold them, nor every library open them.
    """
    for argument in arguments:
        if not argument or re.fullmatch(r"--[\w-]+=", argument):
            return f"expected arguments that are not empty, got {argument!r}"
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
    """Prints what the package says, as it is."""

    def emit(self, record: logging.LogRecord) -> None:
        print(with_options(record.getMessage(), getattr(record, "arguments", ())), flush=True)


@contextlib.contextmanager
def spoken() -> Iterator[None]:
    """Print what the package logs, from INFO on, while a command runs."""
    logger, handler = logging.getLogger("univoxel"), _Plain()
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)


def _deferred(command: Callable[..., None]) -> Callable[..., functools.partial[None]]:
    """A function of the same signature that returns the call instead of making it."""

    @functools.wraps(command)
    def prepare(*args, **kwargs):
        return functools.partial(command, *args, **kwargs)

    return prepare


def _gist(box: str) -> str:
    """The message alone, on one line, of the box that tyro draws around an error.

    The box has a title, the message and hints, with rules between them.
    """
    lines = [line.strip("│╰╯ ") for line in box.splitlines()][1:]
    ruled = [bool(line) and not line.strip("─-") for line in lines]
    begin = ruled[:1] == [True]  # without UTF-8 there is a rule under the title
    message = lines[begin : ruled.index(True, begin)] if True in ruled[begin:] else lines
    return " ".join(" ".join(message).split()).rstrip(".")


def _kept(call: functools.partial[None]) -> str:
    """What an interrupted command left behind."""
    out = call.keywords.get("out")
    if call.func in (compare, chart, stress):
        return f"; {out} keeps the trainings that are done: the same command goes on"
    if call.func in (capture, poses):
        return f"; {out} keeps the steps that are done: the same command goes on"
    if call.func is not train or not isinstance(out, Path):
        return ""
    if (out / "scene.safetensors").exists():
        return f"; {out} keeps the last saved state: go on with --resume"
    return f"; nothing was saved in {out} yet"


if __name__ == "__main__":
    sys.exit(main())
