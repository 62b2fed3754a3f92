"""How far jobs are: a bar each of those at work, and one of all; or lines."""

from __future__ import annotations

import time
from collections.abc import Mapping
from datetime import timedelta
from typing import Any

from rich.progress import BarColumn, TaskID, TextColumn, TimeElapsedColumn

from univoxel.bars import bar
from univoxel.jobs.job import Result


class ProgressTable:
    """A row of all jobs, and on a terminal one of each that is at work."""

    def __init__(self, before: int, total: int) -> None:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[facts]}"),
        )
        self.progress = bar(*columns, TimeElapsedColumn())
        self._all = self.progress.add_task("", total=total, facts="")
        self._begin, self._before, self._total = time.monotonic(), before, total
        self._ended, self._failed = 0, 0
        self._rows: dict[str, TaskID] = {}
        self._told: dict[str, tuple[float, str]] = {}  # share of a job at work, and its step
        self._refresh()

    def tell(self, told: Mapping[str, Any]) -> None:
        """Take in how far a job is: its step, and what its training's log says."""
        name, share, quality = told["job"], told.get("share"), told.get("held_out_psnr")
        text = f"{name} {told['process']}" + ("" if share is None else f" {share:.0%}")
        self._told[name] = share or 0.0, text
        if self.progress.console.is_terminal:
            if name not in self._rows:
                self._rows[name] = self.progress.add_task("", total=1.0, facts="")
            facts = "" if quality is None else f"held-out {quality:.1f} dB"
            row = {"completed": share or 0.0, "description": text, "facts": facts}
            self.progress.update(self._rows[name], **row)
        self._refresh()

    def ended(self, result: Result) -> None:
        """Take in how a sitting of a job ended."""
        self._told.pop(result.name, None)
        if result.name in self._rows:
            self.progress.remove_task(self._rows.pop(result.name))
        self._ended += result.state in ("done", "failed")
        self._failed += result.state == "failed"
        self._refresh()

    def _refresh(self) -> None:
        made = self._ended + sum(share for share, _ in self._told.values())
        facts = [f"{self._failed} failed"] if self._failed else []
        if not self.progress.console.is_terminal:
            facts += [text for _, text in self._told.values()][:4]
        if self._ended:
            spent, left = time.monotonic() - self._begin, self._total - self._before - made
            facts.append(f"about {timedelta(seconds=round(spent * left / made))} left")
        row = {"completed": self._before + made, "facts": "  ".join(facts)}
        ended = f"{self._before + self._ended}/{self._total}"
        self.progress.update(self._all, description=ended, **row)
