"""A job: its steps as command lines, and the record of how far it is."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from univoxel.errors import DataError, ExistingFile
from univoxel.files import read_json, replacing


@dataclass(frozen=True)
class Step:
    """One process of a job."""

    name: str
    arguments: tuple[str | tuple[Path, ...], ...]  # of Python; of paths the first that is there
    makes: Path | None = None  # whole or absent: where it is there the step is done; None: never
    after: Path | None = None  # what it makes must not be older than this file
    unless: tuple[Path, ...] = ()  # where one of these is there the step is done, too
    log: Path | None = None  # of a training
    needed: bool = True  # steps after it make no sense without it

    def done(self) -> bool:
        """Whether there is nothing left to do."""
        if self.makes is None or not self.makes.exists():
            return any(path.exists() for path in self.unless)
        if self.after is None or not self.after.exists():
            return True
        return self.makes.stat().st_mtime_ns >= self.after.stat().st_mtime_ns

    def words(self) -> list[str]:
        """The arguments as they are now; where no path is there, the last."""
        choices = [(a,) if isinstance(a, str) else a for a in self.arguments]
        return [str(next((a for a in c[:-1] if Path(a).exists()), c[-1])) for c in choices]


@dataclass(frozen=True)
class Record:
    """What is known of a job from all sittings."""

    identity: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)  # spent, by step
    errors: dict[str, str] = field(default_factory=dict)  # by step that failed last time


@dataclass(frozen=True)
class Job:
    """Steps, one after another, that no two processes shall be at work on at once."""

    name: str  # unique
    steps: tuple[Step, ...]
    files: Path  # beginning of its files: .lock, .txt (what processes say) and .json (its record)
    identity: dict[str, Any] = field(default_factory=dict)  # what its results follow from; JSON
    threads: int | None = None  # of its processes; None: its share of a worker's machine

    def file(self, suffix: str) -> Path:
        return self.files.with_name(self.files.name + suffix)

    def record(self) -> Record:
        """What is recorded; earlier versions recorded more.

        Raises:
            DataError: the file is no record.
        """
        path = self.file(".json")
        found = read_json(path) if path.exists() else {}
        known = {f.name for f in dataclasses.fields(Record)}
        if not (isinstance(found, dict) and all(isinstance(found.get(k, {}), dict) for k in known)):
            raise DataError(f"{path}: expected the record of a job: remove it")
        return Record(**{key: value for key, value in found.items() if key in known})

    def save(self, record: Record) -> None:
        """Write the record, whole or not at all."""
        with replacing(self.file(".json")) as temporary:
            text = json.dumps(dataclasses.asdict(record), indent=1)
            temporary.write_text(text + "\n", encoding="utf-8")

    def check_same(self) -> None:
        """Refuse to go on with what other options began.

        Raises:
            ExistingFile: they are others.
        """
        before = self.record().identity
        other = [key for key, value in self.identity.items() if before and before.get(key) != value]
        if other:
            where = f"{self.name}: {self.file('.json')} is of another {' and '.join(other)}"
            hint = "choose another out, or remove that file and the folder of its results"
            raise ExistingFile(f"{where}: {hint}", "out")


@dataclass(frozen=True)
class Result:
    """How a sitting of a job ended."""

    name: str
    state: Literal["done", "failed", "killed", "locked"]  # locked: another is at work on it
    errors: dict[str, str] = field(default_factory=dict)  # a line each, by step
    seconds: float = 0.0  # of this sitting
