"""Become a command that ends with the process that began it: PID COMMAND [ARGUMENT ...].

A process that is killed cannot end those that it began. They would go on alone, and write into
files beside those that are begun again. Linux ends them.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys

PR_SET_PDEATHSIG = 1  # of <sys/prctl.h>; it stays through exec


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
