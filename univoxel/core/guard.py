"""Child processes of Python that run the package and end with their parent.

A process that is killed cannot end those that it began. They would continue alone, and write into
files beside those that are begun again.

Python looks for modules in the working folder first, which may be anybody's: a folder of
photographs that holds a `random.py`, or a clone that is not built. These processes do not.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import IO, Any

# Takes the working folder, '', off the path before anything is imported, then packages from the
# files that are named. `-P` does the first alone, since Python 3.11
BEGINNING = """
import sys
sys.path[:] = [place for place in sys.path if place]
import importlib.util
_, parent, count, *rest = sys.argv
for named in rest[:int(count)]:
    name, _, file = named.partition("=")
    spec = importlib.util.spec_from_file_location(name, file)
    sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules[name])
from univoxel.core import system
system.end_with(int(parent))
sys.argv[1:] = rest[int(count):]
"""
MODULE = """
import runpy
del sys.argv[0]
runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
"""


def command(arguments: Sequence[str]) -> list[str]:
    """The command line of a Python process that runs this package and imports nothing from the
    working folder; it ends with this process. The arguments begin with -m MODULE or -c PROGRAM."""
    packages = dict.fromkeys(name.partition(".")[0] for name in (__name__, arguments[1]))
    files = [f"{p}={sys.modules[p].__file__}" for p in packages if p in sys.modules]
    kind, what, *rest = arguments
    program, rest = (MODULE, [what, *rest]) if kind == "-m" else (what, rest)
    facts = str(os.getpid()), str(len(files)), *files
    return [sys.executable, "-c", BEGINNING + program, *facts, *rest]


def environment(variables: Mapping[str, str] = os.environ) -> dict[str, str]:
    """Variables for such a process: an empty place in PYTHONPATH would be the working folder."""
    places = variables.get("PYTHONPATH", "").split(os.pathsep)
    others = os.pathsep.join(place for place in places if place not in ("", os.curdir))
    return {**variables, "PYTHONPATH": others}


@contextmanager
def guarded(
    arguments: Sequence[str], output: IO[bytes], **options: Any
) -> Iterator[subprocess.Popen[bytes]]:
    """A process of `command`, which ends with the block at the latest.

    Args:
        output: takes all that it says.
        options: more of Popen's.
    """
    options |= {"stdin": subprocess.DEVNULL, "stdout": output, "stderr": output}
    options |= {"env": environment(options.get("env", os.environ))}
    process: Any = subprocess.Popen(command(arguments), **options)
    try:
        yield process
    finally:
        process.kill()  # only where the block was broken off is it still there
        process.wait()


def last_words(said: bytes) -> str:
    """The last line of what a process said; nothing where it said nothing."""
    return said.decode("utf-8", "replace").strip().rpartition("\n")[2].strip()
