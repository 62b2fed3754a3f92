"""Processes that end with the one that began them; as a program, PID ARGUMENT ... of Python.

A process that is killed cannot end those that it began. They would go on alone, and write into
files beside those that are begun again.
"""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import IO, Any

from univoxel.core import system


@contextmanager
def guarded(
    arguments: Sequence[str], output: IO[bytes], **options: Any
) -> Iterator[subprocess.Popen[bytes]]:
    """A process of Python, which ends with the block at the latest, and with this process.

    Args:
        arguments: of Python: -m and a module, or a file, and what follows.
        output: takes all that it says.
        options: more of Popen's.
    """
    command = [sys.executable, "-m", __name__, str(os.getpid()), *arguments]
    options |= {"stdin": subprocess.DEVNULL, "stdout": output, "stderr": output}
    process: Any = subprocess.Popen(command, **options)
    try:
        yield process
    finally:
        process.kill()  # only where the block was broken off is it still there
        process.wait()


def last_words(said: bytes) -> str:
    """The last line of what a process said; nothing where it said nothing."""
    return said.decode("utf-8", "replace").strip().rpartition("\n")[2].strip()


def main(parent: int, arguments: list[str]) -> None:
    """Go on as Python with these arguments."""
    if system.end_with(parent):
        os.execv(sys.executable, [sys.executable, *arguments])
    # What watches is a thread of this process, which therefore runs the program itself
    module = arguments[0] == "-m"
    sys.argv = arguments = arguments[module:]
    if module:
        runpy.run_module(arguments[0], run_name="__main__", alter_sys=True)
    else:
        runpy.run_path(arguments[0], run_name="__main__")


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2:])
