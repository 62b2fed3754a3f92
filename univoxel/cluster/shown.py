"""How far pieces of work are: a bar each of those at work, and one of all; or lines."""

from __future__ import annotations

import time
from collections.abc import Sequence

from rich.progress import BarColumn, TaskID, TextColumn, TimeElapsedColumn

from univoxel.bars import bar
from univoxel.cluster.piece import Ended, Piece, Told

SILENT_SECONDS = 30.0  # after which a piece that tells nothing is no longer shown


class Shown:
    """What of the pieces is shown. Used in a `with` block."""

    def __init__(self, pieces: Sequence[Piece], total: int) -> None:
        """
        Args:
            total: pieces with those that were done before.
        """
        self._pieces = {piece.name: piece for piece in pieces}
        self._begin = time.monotonic()
        self._told: dict[str, tuple[float, Told]] = {}  # and when, by name
        self._rows: dict[str, TaskID] = {}
        self._before, self._total = total - len(pieces), total
        self._done, self._failed = 0, 0  # in this sitting
        self._spent, self._expected = 0.0, 0.0  # seconds of pieces that were done
        self._progress = bar(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[facts]}"),
            TimeElapsedColumn(),
        )
        self._all = self._progress.add_task("", total=total, completed=self._before, facts="")

    def __enter__(self) -> Shown:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def now(self, told: Told) -> None:
        """Take in how far a piece is."""
        if told.name in self._pieces:
            self._told[told.name] = time.monotonic(), told

    def ended(self, found: Ended) -> None:
        """Take in that a piece has ended."""
        piece = self._pieces.pop(found.name)
        self._told.pop(found.name, None)
        self._done += 1
        self._failed += found.state == "failed"
        if found.state == "done":
            self._spent, self._expected = (
                self._spent + found.seconds,
                self._expected + piece.seconds,
            )

    def refresh(self, slots: int) -> None:
        """Show it.

        Args:
            slots: pieces that workers take at once.
        """
        now = time.monotonic()
        fresh = {n: told for n, (when, told) in self._told.items() if now - when < SILENT_SECONDS}
        self._progress.update(
            self._all,
            completed=self._before + self._done,
            description=f"{self._before + self._done}/{self._total}",
            facts="  ".join(self._facts(fresh, slots)),
        )
        if not self._progress.console.is_terminal:
            return
        for name in [name for name in self._rows if name not in fresh]:
            self._progress.remove_task(self._rows.pop(name))
        for name, told in fresh.items():
            if name not in self._rows:
                self._rows[name] = self._progress.add_task(name, total=1.0, facts="")
            facts = "  ".join(facts_of(told))
            self._progress.update(
                self._rows[name],
                completed=told.share or 0.0,
                description=f"{name} {told.step}",
                facts=facts,
            )

    def left(self, slots: int) -> float | None:
        """Seconds that all may take from now on; None: there are no workers."""
        if not slots:
            return None
        # How long earlier pieces of this sitting took against what was expected of them
        pace = self._spent / self._expected if self._expected else 1.0
        wanted = sum(piece.seconds for piece in self._pieces.values())
        made = sum(
            min(told.seconds, self._pieces[n].seconds) for n, (_, told) in self._told.items()
        )
        return max(pace * wanted - made, 0.0) / min(slots, max(len(self._pieces), 1))

    def _facts(self, fresh: dict[str, Told], slots: int) -> list[str]:
        facts = [f"{self._failed} failed"] if self._failed else []
        if not self._progress.console.is_terminal:
            facts += [f"{n} {told.step}{_percent(told)}" for n, told in list(fresh.items())[:4]]
        hours = (time.monotonic() - self._begin) / 3600
        if self._done and hours:
            facts.append(f"{self._done / hours:.3g} an hour")
        left = self.left(slots)
        facts.append("waits for workers" if left is None else f"about {minutes(left)} left")
        return facts


def facts_of(told: Told) -> list[str]:
    """What a row says of a piece at work."""
    facts = [_percent(told).strip()] if told.share is not None else []
    if told.rays_per_second is not None:
        facts.append(f"{told.rays_per_second / 1e3:.0f}k rays/s")
    if told.held_out_psnr is not None:
        facts.append(f"held-out {told.held_out_psnr:.1f} dB")
    if told.share:
        facts.append(f"{minutes(told.seconds * (1 - told.share) / told.share)} left")
    return facts


def minutes(seconds: float) -> str:
    """A length of time as people say it."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _percent(told: Told) -> str:
    return "" if told.share is None else f" {told.share:.0%}"
