"""Become a command that ends with the process that began it.

    python -m univoxel.child PID LOCK COMMAND [ARGUMENT ...]

A process that is killed cannot end those that it began. They would go on alone, and write into
files beside those that are begun again. Linux ends them. Elsewhere the lock, a file that the
command holds until it ends, keeps a second one away; "-" is none.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys

PR_SET_PDEATHSIG = 1  # of <sys/prctl.h>; it stays through exec
LOCKED = 75  # exit code: another holds the lock; EX_TEMPFAIL of <sysexits.h>


def main(parent: int, lock: str, command: list[str]) -> None:
    """Replace this process by the command."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it was killed before it could be asked for
            sys.exit(1)
    if lock != "-" and not hold(lock):
        sys.exit(LOCKED)
    if os.name == "nt":  # exec there begins another process, and ends this one at once
        sys.exit(subprocess.call(command))
    os.execvp(command[0], command)


def hold(path: str) -> bool:
    """Lock a file until this process, and what it becomes, has ended; False: another has."""
    try:
        import fcntl
    except ImportError:  # Windows
        return True
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    os.set_inheritable(descriptor, True)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2], sys.argv[3:])
