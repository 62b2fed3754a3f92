"""Atomic file writing, JSON files, and records of finished steps in a folder."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from univoxel.core import system
from univoxel.errors import DataError, ExistingFile


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Give a temporary path beside `path` to write to; it takes the place of `path` at the end.

    If the block raises, the temporary file is removed and `path` is as it was. OSError comes out
    naming `path`.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        yield temporary
        if temporary.is_file():
            temporary.chmod(system.NEW_FILE)  # safetensors lets nobody else read what it writes
        system.replace(temporary, path)
    except OSError as error:
        raise OSError(error.errno, f"cannot write: {error.strerror}", str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


def write_bytes(path: str | Path, data: bytes | memoryview) -> None:
    """Write a file, whole or not at all; an OSError if it cannot be."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: str | Path, text: str) -> None:
    """The same of text."""
    write_bytes(path, text.encode())


def write_json(path: str | Path, value: Any) -> None:
    """The same of JSON; paths become text."""
    write_text(path, json.dumps(value, indent=1, default=str) + "\n")


def append_line(path: Path, line: str) -> None:
    """Append a line to a file, whole or not at all; an OSError if it cannot be."""
    before = path.stat().st_size if path.exists() else 0
    try:
        with path.open("ab", buffering=0) as file:
            text = f"{line}\n".encode()
            if file.write(text) < len(text):  # what fits is written; the next write would fail
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    except OSError as error:
        if path.exists() and path.stat().st_size > before:
            os.truncate(path, before)
        raise OSError(error.errno, f"cannot write: {error.strerror}", str(path)) from error


def read_json(path: Path) -> Any:
    """What a JSON file holds; it may begin with a byte order mark.

    Raises:
        DataError: not JSON, not UTF-8, nested too deep or with a number too long to read; names the
            file.
        OSError: the file cannot be read.
    """
    try:
        return json.loads(path.read_bytes().decode("utf-8-sig"))
    except json.JSONDecodeError as error:
        raise DataError(
            f"{path}: invalid JSON in line {error.lineno}, column {error.colno}: {error.msg}"
        ) from None
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: expected text in UTF-8, got {error.reason}") from None
    except RecursionError:
        raise DataError(f"{path}: this JSON is nested too deeply") from None
    except ValueError:  # Python converts no integers of more than 4300 digits
        raise DataError(f"{path}: expected JSON, but an integer has too many digits") from None


# Which steps of a task are done in a folder, and with what: one file, beside what they made.
#
# A step has a fingerprint: what it was made of and how, as JSON. So the same call goes on where it
# was interrupted, and another one is refused before it mixes what it makes with what is there.


FILE = "steps.json"


def finish(folder: Path, step: str, fingerprint: Any) -> None:
    """Note that a step is done; the folder is made if there is none."""
    _write(folder, _read(folder) | {step: fingerprint})


def forget(folder: Path, *steps: str) -> None:
    """Let steps not be done."""
    _write(folder, {s: fingerprint for s, fingerprint in _read(folder).items() if s not in steps})


def recorded(folder: Path, step: str) -> Any:
    """The fingerprint that a step was done with; None: it is not done."""
    return _read(folder).get(step)


def done(
    folder: Path, step: str, fingerprint: Any, refusal: Callable[[Any], ExistingFile] | None = None
) -> bool:
    """Whether a step is done; an ExistingFile if it was with another fingerprint.

    Args:
        refusal: makes the error of the other fingerprint.
    """
    before = recorded(folder, step)
    if before is None or before == as_json(fingerprint):
        return before is not None
    if refusal is not None:
        raise refusal(before)
    raise ExistingFile(
        f"{folder}: {step} was made with other options: choose another folder for out", "out"
    )


def as_json(fingerprint: Any) -> Any:
    """A fingerprint as it is read back: tuples are lists."""
    return json.loads(json.dumps(fingerprint))


def adopt(folder: Path, noted: dict[str, Any]) -> None:
    """Take over what an earlier version noted in another way, where no step is noted yet."""
    if noted and not (folder / FILE).exists():
        _write(folder, noted)


def _read(folder: Path) -> dict[str, Any]:
    path = folder / FILE
    found = read_json(path) if path.exists() else {}
    if not isinstance(found, dict):
        raise DataError(f"{path}: expected a JSON object of steps, got {type(found).__name__}")
    return found


def _write(folder: Path, steps: dict[str, Any]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / FILE, steps)
