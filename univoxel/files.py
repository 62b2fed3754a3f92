"""Files that appear whole or not at all, and JSON in files."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from univoxel.errors import DataError


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
        os.replace(temporary, path)
    except OSError as error:
        raise OSError(error.errno, f"cannot write: {error.strerror}", str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


def append_line(path: Path, line: str) -> None:
    """Append a line to a file, whole or not at all.

    Raises:
        OSError: the file cannot be written; it is as it was.
    """
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
            f"{path}: broken JSON in line {error.lineno}, column {error.colno}: {error.msg}"
        ) from None
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: expected text in UTF-8, got {error.reason}") from None
    except RecursionError:
        raise DataError(f"{path}: expected JSON, got lists or objects nested too deep") from None
    except ValueError:  # Python converts no integers of more than 4300 digits
        raise DataError(f"{path}: expected JSON, got an integer of too many digits") from None
