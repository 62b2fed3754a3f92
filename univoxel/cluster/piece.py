"""A piece of work as records: what is to be done, how far it is, and how it ended."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from univoxel.errors import DataError
from univoxel.files import read_json, replacing

State = Literal["done", "failed", "died", "taken"]


@dataclass(frozen=True)
class FirstOf:
    """An argument: the first of some paths that is there when a step begins, or else the last."""

    paths: tuple[Path, ...]

    def __str__(self) -> str:
        return str(next((path for path in self.paths if path.exists()), self.paths[-1]))


@dataclass(frozen=True)
class Step:
    """One process of a piece."""

    name: str
    arguments: tuple[str | FirstOf, ...]  # of Python
    makes: Path | None = None  # whole or absent: where it is there the step is done; None: never
    after: Path | None = None  # what it makes must not be older than this file
    unless: tuple[Path, ...] = ()  # where one of these is there the step is done, too
    log: Path | None = None  # that a training tells in
    needed: bool = True  # steps after it make no sense without it

    def done(self) -> bool:
        """Whether there is nothing left to do."""
        if any(path.exists() for path in self.unless):
            return True
        if self.makes is None or not self.makes.exists():
            return False
        if self.after is None or not self.after.exists():
            return True
        return self.makes.stat().st_mtime_ns >= self.after.stat().st_mtime_ns


@dataclass(frozen=True)
class Piece:
    """Steps, one after another, that no two processes shall be at work on at once."""

    name: str  # unique
    steps: tuple[Step, ...]
    lock: Path  # file of who is at work on it; its folder is made
    output: Path  # file for what processes say; appended to
    record: Path | None = None  # file for a `Record`
    identity: dict[str, Any] = field(default_factory=dict)  # kept in the record; JSON
    threads: int | None = None  # of its processes; None: its share of a worker's machine
    seconds: float = 60.0  # that it may take, a guess


@dataclass(frozen=True)
class Record:
    """What is known of a piece from all sittings."""

    identity: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)  # spent, by step
    errors: dict[str, str] = field(default_factory=dict)  # by step that failed last time
    where: str = ""  # the machine that was last at work on it

    def save(self, path: Path) -> None:
        """Write it, whole or not at all.

        Raises:
            OSError: it cannot be written.
        """
        with replacing(path) as temporary:
            text = json.dumps(dataclasses.asdict(self), indent=1)
            temporary.write_text(text + "\n", encoding="utf-8")


def load_record(path: Path | None) -> Record:
    """What a file holds; an empty record where there is none.

    Raises:
        DataError: it is no such file.
    """
    if path is None or not path.exists():
        return Record()
    try:
        return Record(**read_json(path))
    except TypeError as error:
        raise DataError(f"{path}: expected the record of a piece of work: {error}") from None


@dataclass(frozen=True)
class Told:
    """How far a piece is."""

    name: str
    step: str
    seconds: float  # since the step began
    share: float | None = None  # of the step, in [0, 1]
    rays_per_second: float | None = None
    held_out_psnr: float | None = None  # dB


@dataclass(frozen=True)
class Ended:
    """How a sitting of a piece ended."""

    name: str
    state: State  # died: a process of it was killed; taken: others are at work on it
    errors: dict[str, str] = field(default_factory=dict)  # a line each, by step
    seconds: float = 0.0  # of this sitting
    where: str = ""  # machine
