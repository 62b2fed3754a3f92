"""Processes that end with the one that began them; as a program, PID COMMAND [ARGUMENT ...].

A process that is killed cannot end those that it began. They would go on alone, and write into
files beside those that are begun again. Linux ends them.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import IO, Any

PR_SET_PDEATHSIG = 1  # of <sys/prctl.h>; it stays through exec


@contextmanager
def guarded(
    arguments: Sequence[str], output: IO[bytes], **options: Any
) -> Iterator[subprocess.Popen[bytes]]:
    """A process of Python, which ends with the block at the latest, and with this process.

    Args:
        output: takes all that it says.
        options: more of Popen's.
    """
    command = [sys.executable, "-m", __name__, str(os.getpid()), sys.executable, *arguments]
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


def main(parent: int, command: list[str]) -> None:
    """Replace this process by the command."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it was killed before it could be asked for
            sys.exit(1)
    if os.name == "nt":  # exec there begins another process, and ends this one at once
        sys.exit(subprocess.call(command))
    os.execvp(command[0], command)


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2:])
