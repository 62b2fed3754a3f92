"""Progress bars: on stderr, and only where that is a terminal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TypeVar

from rich.console import Console
from rich.progress import Progress, ProgressColumn

T = TypeVar("T")


def bar(*columns: ProgressColumn, shown: bool = True) -> Progress:
    """A bar of these columns, or rich's own."""
    console = Console(stderr=True)
    return Progress(*columns, console=console, disable=not (shown and console.is_terminal))


def track(items: Sequence[T], description: str) -> Iterator[T]:
    """The items one by one, with a bar of how many are done."""
    with bar() as progress:
        yield from progress.track(items, description=description)
