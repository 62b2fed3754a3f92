"""Progress bars, shown if the logger `univoxel` is enabled for INFO.

A bar on stderr where that is a terminal; elsewhere a line of the log now and then.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from time import monotonic
from typing import TypeVar

from rich.console import Console
from rich.progress import Progress, ProgressColumn, TaskID
from rich.text import Text

from univoxel.core import log

T = TypeVar("T")

LINE_SECONDS = 10.0  # between lines, if there is no bar


class _Lines(Progress):
    """Progress as lines of the log, of the columns that are text."""

    def __init__(self, *columns: ProgressColumn, console: Console) -> None:
        super().__init__(*columns, console=console, disable=True, auto_refresh=False)
        self._told = monotonic()

    def update(self, task_id: TaskID, **changes) -> None:
        super().update(task_id, **changes)
        self._tell(task_id)

    def advance(self, task_id: TaskID, advance: float = 1) -> None:
        super().advance(task_id, advance)
        self._tell(task_id)

    def _tell(self, task_id: TaskID) -> None:
        if monotonic() - self._told < LINE_SECONDS:
            return
        self._told = monotonic()
        task = next(task for task in self.tasks if task.id == task_id)
        cells = [column(task) for column in self.columns if isinstance(column, ProgressColumn)]
        line = "  ".join(cell.plain.strip() for cell in cells if isinstance(cell, Text))
        log.info("%s", line, extra={"progress": True})


def bar(*columns: ProgressColumn, shown: bool = True) -> Progress:
    """A bar of these columns, or rich's own."""
    console = Console(stderr=True)
    if not (shown and log.isEnabledFor(logging.INFO)):
        return Progress(*columns, console=console, disable=True, auto_refresh=False)
    if not console.is_terminal:
        return _Lines(*columns, console=console)
    return Progress(*columns, console=console)


def duration(seconds: float) -> str:
    """A duration for people: tens of seconds, or minutes."""
    return f"{10 * math.ceil(seconds / 10)} s" if seconds < 90 else f"{seconds / 60:.0f} min"


def track(items: Sequence[T], description: str) -> Iterator[T]:
    """The items one by one, with a bar of how many are done."""
    with bar() as progress:
        yield from progress.track(items, description=description)
