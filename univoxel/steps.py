"""Which steps of a task are done in a folder, and with what: one file, beside what they made.

A step has a fingerprint: what it was made of and how, as JSON. So the same call goes on where it
was interrupted, and another one is refused before it mixes what it makes with what is there.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from univoxel.errors import DataError, ExistingFile
from univoxel.files import read_json, replacing

FILE = "steps.json"


def finish(folder: Path, step: str, fingerprint: Any) -> None:
    """Note that a step is done; the folder is made where there is none."""
    _write(folder, _read(folder) | {step: fingerprint})


def forget(folder: Path, *steps: str) -> None:
    """Let steps not be done."""
    _write(folder, {s: fingerprint for s, fingerprint in _read(folder).items() if s not in steps})


def recorded(folder: Path, step: str) -> Any:
    """The fingerprint that a step was done with; None: it is not done."""
    return _read(folder).get(step)


def done(
    folder: Path,
    step: str,
    fingerprint: Any,
    refusal: Callable[[Any], ExistingFile] | None = None,
) -> bool:
    """Whether a step is done.

    Args:
        refusal: makes the error of the fingerprint that it was done with.

    Raises:
        ExistingFile: it was done with another fingerprint.
    """
    before = recorded(folder, step)
    if before is None or before == as_json(fingerprint):
        return before is not None
    if refusal is not None:
        raise refusal(before)
    raise ExistingFile(f"{folder}: {step} has other options: choose another out", "out")


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
        raise DataError(f"{path}: expected an object of steps, got {type(found).__name__}")
    return found


def _write(folder: Path, steps: dict[str, Any]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(folder / FILE) as temporary:
        temporary.write_text(json.dumps(steps) + "\n", encoding="utf-8")
