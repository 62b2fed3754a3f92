"""Differences between Linux, macOS and Windows: files, processes, resources of the machine.

Nothing else of the package asks which system it runs on. Where Linux says more, in its own files,
`machine` reads that first.
"""

from __future__ import annotations

import ctypes
import os
import re
import signal
import struct
import sys
import tempfile
import threading
import time
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

LINUX, MACOS, WINDOWS = "linux", "darwin", "win32"  # as sys.platform has them

# Files.


_MASK = os.umask(0)
os.umask(_MASK)
NEW_FILE = 0o666 & ~_MASK  # mode of new files; Windows takes of it whether they can be written

REPLACED_WITHIN = 5.0  # seconds that a file may be open elsewhere, as virus scanners have new ones
# What Windows gives no file as a name, and devices, which have theirs in every folder
_NO_NAME = re.compile(
    r'[<>:"|?*\x00-\x1f]|[ .]$|^(CON|PRN|AUX|NUL|COM\d|LPT\d)(\.|$)', re.IGNORECASE
)
F_PREALLOCATE, F_ALLOCATEALL, F_PEOFPOSMODE, F_FULLFSYNC = 42, 4, 3, 51  # of macOS's <fcntl.h>


def replace(source: Path, target: Path) -> None:
    """Give a file the name of another, which is gone then: whoever looks sees one of the two. An
    OSError if it cannot be; on Windows also where another program keeps the other file open."""
    end = time.monotonic() + REPLACED_WITHIN
    while True:
        try:
            return os.replace(source, target)
        except PermissionError:
            if sys.platform != WINDOWS or time.monotonic() > end:
                raise
        time.sleep(0.05)


def flush(path: Path) -> None:
    """Write what a file holds to the disk: a crash of the machine does not lose it."""
    with path.open("r+b") as file:  # Windows flushes what may be written
        if sys.platform == MACOS:  # whose fsync leaves it in the disk's memory
            import fcntl

            fcntl.fcntl(file.fileno(), F_FULLFSYNC)
        else:
            os.fsync(file.fileno())


def reserve(descriptor: int, size: int) -> None:
    """Make an empty open file as long, on the disk too; an OSError if there is no room."""
    if sys.platform == LINUX:
        os.posix_fallocate(descriptor, 0, size)
        return
    if sys.platform == MACOS:
        import fcntl

        there = os.fstat(descriptor).st_size
        wanted = struct.pack("Iiqqq", F_ALLOCATEALL, F_PEOFPOSMODE, 0, size - there, 0)
        fcntl.fcntl(descriptor, F_PREALLOCATE, wanted)
    os.truncate(descriptor, size)  # NTFS then has the room, or raises


def can_map() -> bool:
    """Whether arrays can be files that vanish with them: Windows keeps what is in use."""
    return sys.platform in (LINUX, MACOS)


@contextmanager
def vanishing_file(folder: Path) -> Iterator[tuple[int, Path]]:
    """An open file and a path to it, for the block; what maps it keeps it.

    On Linux nobody else sees it, and it vanishes also where the process is killed in the block.
    """
    if sys.platform == LINUX:
        with tempfile.TemporaryFile(dir=folder, prefix=".univoxel-") as file:
            yield file.fileno(), Path(f"/proc/self/fd/{file.fileno()}")
    else:
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".univoxel-", suffix=".tmp") as file:
            yield file.fileno(), Path(file.name)


def folded(name: str) -> str:
    """A name as any system may compare it: Windows does not tell case apart, Macs take letters
    apart."""
    return unicodedata.normalize("NFC", name).casefold()


def file_key(name: str) -> str:
    """A name of a file as this system compares it: equal of two names that are one file."""
    return name if sys.platform == LINUX else folded(name)


def can_be_a_name(name: str) -> bool:
    """Whether a file can have this name, of which it is known that it names no folder."""
    return sys.platform != WINDOWS or _NO_NAME.search(name) is None


# Processes.


PR_SET_PDEATHSIG = 1  # of <sys/prctl.h>; it stays through exec
WATCHED_EVERY = 0.5  # seconds
CREATE_NEW_PROCESS_GROUP = 0x200  # of Windows, as subprocess has it there only
FAULT = 0xC0000000  # exit codes of Windows from which on the system ended a process
FAULTS = {0xC0000005: "an access violation", 0xC0000017: "a lack of memory"}


def own_session() -> dict[str, Any]:
    """Options of subprocess.Popen for a process that Ctrl-C does not reach."""
    if sys.platform == WINDOWS:
        return {"creationflags": CREATE_NEW_PROCESS_GROUP}
    return {"start_new_session": True}


def ended_by(code: int) -> str | None:
    """What ended a process, by its exit code in subprocess; None: itself."""
    if code < 0:
        return signal.Signals(-code).name
    if code >= FAULT:
        return FAULTS.get(code, f"fault {code:#x}")
    return None


def end_with(parent: int) -> None:
    """Let this process end when the one that began it ends, however that ends."""
    if sys.platform == LINUX:
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it was killed before it could be asked for
            sys.exit(1)
        return
    import psutil

    try:
        watched = psutil.Process(parent)
    except psutil.NoSuchProcess:
        sys.exit(1)

    def watch() -> None:
        # A process that nobody waited for is there, and at an end
        while watched.is_running() and watched.status() != psutil.STATUS_ZOMBIE:
            time.sleep(WATCHED_EVERY)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


# The machine.


def usable_cores() -> int:
    """Cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def memory() -> tuple[int, int] | None:
    """Memory of the machine, bytes, and what of it is to be had; None: not known."""
    try:
        import psutil
    except ImportError:
        return None
    found = psutil.virtual_memory()
    return found.total, found.available


def release_memory() -> None:
    """Return freed memory to the system. glibc keeps it for the process; others need no call."""
    if sys.platform == LINUX:
        getattr(ctypes.CDLL(None), "malloc_trim", lambda _: 0)(0)  # musl has none


def peak_memory_mb() -> float | None:
    """Most memory that this process has had, MiB."""
    if sys.platform == WINDOWS:
        import psutil

        info: Any = psutil.Process().memory_info()
        return info.peak_wset / (1 << 20)
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1 << 20 if sys.platform == MACOS else 1 << 10)  # macOS counts bytes


def load() -> float | None:
    """Processes that ran or waited for a core, the mean over a minute."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else None
