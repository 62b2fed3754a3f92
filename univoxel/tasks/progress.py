"""The clock, the bar and the log of a training run."""

from __future__ import annotations

import errno
import json
import os
import resource
import time
from collections.abc import Iterator
from pathlib import Path

import torch
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar

from univoxel.config import TrainConfig

REPORT_SECONDS = 5.0
CHECKPOINT_SECONDS = 60.0
RESERVE_SECONDS = 4.0  # of the budget, kept for the last checkpoint and the preview


class Progress:
    """Counts a run against its steps and its time, whichever is further along, and tells of it.

    A schedule follows `steps()`: on a slow machine a stage makes fewer steps and still runs through
    the whole of its schedule.
    """

    def __init__(self, cfg: TrainConfig, begin: float, state: dict):
        self.cfg, self.begin = cfg, begin
        self.stage, self.done, self.step = state["stage"], state["progress"], state["step"]
        self._log = cfg.out / "log.jsonl"
        self._told, self._told_step = time.monotonic(), self.step
        self._saved = time.monotonic()
        self._bar = Bar(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:3.0f} %  {task.fields[facts]}"),
            TimeElapsedColumn(),
        )
        self._task = self._bar.add_task("", total=1.0, facts="")

    def __enter__(self) -> Progress:
        self._bar.start()
        return self

    def __exit__(self, *_) -> None:
        self._bar.stop()

    @property
    def seconds(self) -> float:
        """Training time so far, over all sittings."""
        return time.monotonic() - self.begin

    def state(self) -> dict:
        """What a later sitting needs to go on, and what evaluation reports; JSON."""
        return {
            "stage": self.stage,
            "progress": self.done,
            "step": self.step,
            "seconds": self.seconds,
            "threads": torch.get_num_threads(),
            "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        }

    def steps(self) -> Iterator[float]:
        """Progress through the present stage in [0, 1), once a step; then the next stage is on."""
        stage, first, count = self.cfg.stages[self.stage], self.done, 0
        begin = time.monotonic()
        left = max(60 * self.cfg.minutes - RESERVE_SECONDS - self.seconds, 0.0)
        shares = [(1 - first) * stage.share, *(s.share for s in self.cfg.stages[self.stage + 1 :])]
        allowed = left * shares[0] / sum(shares)
        while True:
            spent = (time.monotonic() - begin) / allowed if allowed else 1.0
            self.done = first + max(count / stage.iterations, (1 - first) * spent)
            if self.done >= 1.0:
                self.stage, self.done = self.stage + 1, 0.0
                return
            yield self.done
            count += 1
            self.step += 1

    def due(self) -> bool:
        """Whether it is time to report."""
        return time.monotonic() - self._told > REPORT_SECONDS

    def checkpoint_due(self) -> bool:
        """Whether a checkpoint is due, for a run that may be killed."""
        if time.monotonic() - self._saved < CHECKPOINT_SECONDS:
            return False
        self._saved = time.monotonic()
        return True

    def report(self, losses: dict[str, float], psnr: float | None) -> None:
        """Move the bar and append a line to the log."""
        now, stage = time.monotonic(), self.cfg.stages[self.stage]
        rate = (self.step - self._told_step) * stage.rays / (now - self._told)
        self._told, self._told_step = now, self.step
        line = self.state() | {"losses": losses, "held_out_psnr": psnr, "rays_per_second": rate}
        append_line(self._log, json.dumps(line))
        shares = [s.share for s in self.cfg.stages]
        by_stage = sum(shares[: self.stage]) + shares[self.stage] * self.done
        whole = max(by_stage / sum(shares), min(self.seconds / (60 * self.cfg.minutes), 1.0))
        remaining = self.seconds * (1 - whole) / max(whole, 1e-3)
        quality = "" if psnr is None else f"held-out {psnr:.1f} dB  "
        self._bar.update(
            self._task,
            completed=whole,
            description=f"stage {self.stage + 1}/{len(shares)}",
            facts=f"loss {sum(losses.values()):.4f}  {quality}"
            f"{rate / 1e3:.0f}k rays/s  {remaining / 60:.0f}:{remaining % 60:02.0f} left ",
        )


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
