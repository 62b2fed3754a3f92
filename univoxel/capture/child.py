"""Become a command that ends with the process that began it.

    python -m univoxel.capture.child PID COMMAND [ARGUMENT ...]

A process that is killed cannot end those that it began. A step of structure from motion would go on
alone, and write into the database beside the step that is begun again. Linux ends it.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

PR_SET_PDEATHSIG = 1  # of <sys/prctl.h>; it stays through exec


def main(parent: int, command: list[str]) -> None:
    """Replace this process by the command."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it was killed before it could be asked for
            sys.exit(1)
    os.execvp(command[0], command)


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2:])
