"""The clock, the bar and the log of a training run."""

from __future__ import annotations

import json
import math
import resource
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar

from univoxel.compression.choices import CapacityChoice
from univoxel.config import TrainConfig
from univoxel.files import append_line

REPORT_SECONDS = 5.0
CHECKPOINT_SECONDS = 60.0
RESERVE_SECONDS = 4.0  # of the budget, kept for the last checkpoint and the preview
PACE = 0.1  # weight of the newest step in the mean time of a step
UNSURE = 4  # first steps of a stage, whose time is no measure for the others
REST = 0.3  # of the steps that are left to a stage that is shortened: for its rates to fall
ALL = 0.995  # share of the planned steps from which on a stage was not cut


class Progress:
    """Counts a run against its steps and its time, whichever is further along, and tells of it.

    A schedule follows `steps()`: on a slow machine a stage makes fewer steps and still runs through
    the whole of its schedule. Every stage gets its share of what is left of the time, so that a run
    that is short of time is short in all its stages.
    """

    def __init__(self, cfg: TrainConfig, begin: float, state: dict):
        """
        Args:
            begin: of training, on time.monotonic's clock.
            state: as `state` gave it.
        """
        self.cfg, self.begin = cfg, begin
        self._stopped: float | None = None  # when the clock was, see `paused`
        self.stage, self.done, self.step = state["stage"], state["progress"], state["step"]
        self.made: list[float] = list(state.get("made", ()))  # share of its steps, by ended stage
        self.early: list[int] = list(state.get("early", ()))  # numbers of shortened stages
        self.chosen = [CapacityChoice.from_json(entry) for entry in state.get("chosen", ())]
        self.troubles: list[str] = list(state.get("troubles", ()))  # what went wrong and was mended
        self._stage_steps = state.get("stage_steps", 0)  # made in the present stage
        self._planned, self._count = 0, 0  # steps of the stage in this sitting
        self._stage_begin = self.seconds  # of the stage in this sitting
        self._stage_end = 0.0  # when its time is over
        self._apart, self._last_apart = 0.0, 0.0  # seconds, see `apart`
        self.reserved = 0.0  # seconds that are kept for blocks under `apart` in this stage
        self.watch: Callable[[], None] | None = None  # called between steps, off the clock
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

    def __exit__(self, kind: type | None, *_) -> None:
        self._bar.stop()
        if kind is not None:
            return
        for told in (*(c.sentence for c in self.chosen), self.cut()):
            if told:
                self.say(told)
        if self.troubles:
            self.say(
                f"training met trouble and went on, {len(self.troubles)} times: look at the result "
                f"before you trust it; the last was in {self.troubles[-1]}"
            )

    @property
    def seconds(self) -> float:
        """Training time so far, over all sittings."""
        now = time.monotonic() if self._stopped is None else self._stopped
        return now - self.begin

    def state(self) -> dict:
        """What a later sitting needs to go on, and what evaluation reports; JSON."""
        return {
            "stage": self.stage,
            "progress": self.done,
            "step": self.step,
            "made": self.made,
            "early": self.early,
            "chosen": [choice.as_json() for choice in self.chosen],
            "troubles": self.troubles,
            "stage_steps": self._stage_steps,
            "seconds": self.seconds,
            "threads": torch.get_num_threads(),
            "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        }

    def steps(self, apart: float = 0.0) -> Iterator[float]:
        """Progress through the present stage in [0, 1), once a step; then the next stage is on.

        What is left of the schedule is spread over the steps that are left: those that were
        planned, or as many as fit into the stage's time as steps went lately.

        Args:
            apart: share of the stage's time, a guess, that passes under `apart`.
        """
        stage, pace = self.cfg.stages[self.stage], 0.0
        shares = [
            (1 - self.done) * stage.share,
            *(s.share for s in self.cfg.stages[self.stage + 1 :]),
        ]
        left = max(60 * self.cfg.minutes - RESERVE_SECONDS - self._stage_begin, 0.0)
        allowed = left * shares[0] / sum(shares)
        self._planned, self._count = max(1, round((1 - self.done) * stage.iterations)), 0
        self._stage_end, self.reserved = self._stage_begin + allowed, apart * allowed
        while self.done < 1 and (begin := self.seconds) < self._stage_end:
            passed = self._apart
            yield self.done
            spent = self.seconds - begin - (self._apart - passed)
            pace = spent if self._count == 0 else (1 - PACE) * pace + PACE * spent
            self.step, self._stage_steps = self.step + 1, self._stage_steps + 1
            self._count += 1
            room = self._stage_end - self.seconds - self.reserved
            steps_left = self._planned - self._count + 1  # with the one that was made
            if self._count > UNSURE and room < pace * (steps_left - 1):
                steps_left = 1 + room / pace if room > 0 else 1
            self.done += (1 - self.done) / max(steps_left, 1)
            if self.done > 1 - 1e-9:
                self.done = 1.0
            if self.watch:
                with self.paused():
                    self.watch()
        self.skip()

    @property
    def over(self) -> bool:
        """Whether the time is up."""
        return self.seconds >= 60 * self.cfg.minutes - RESERVE_SECONDS

    @property
    def pace(self) -> float:
        """Share of its steps that the stage before made, if time cut it short; else 1."""
        last = self.stage - 1
        return self.made[last] if 0 <= last < len(self.made) and last not in self.early else 1.0

    def skip(self) -> None:
        """Leave the present stage as it is for the next."""
        self.made.append(self._stage_steps / self.cfg.stages[self.stage].iterations)
        self.stage, self.done, self._stage_steps = self.stage + 1, 0.0, 0
        self._stage_begin = self.seconds

    def credit(self, share: float) -> None:
        """Count a share of the coming stage's steps as made."""
        self.done = share
        self._stage_steps = round(share * self.cfg.stages[self.stage].iterations)

    def shorten(self) -> None:
        """Run through the rest of the stage's schedule in fewer steps."""
        self._planned = self._count + math.ceil(REST * (self._planned - self._count))
        self.early.append(self.stage)

    def abandon(self) -> None:
        """Leave the present stage, between steps, with what it has."""
        self.done = 1.0
        self.early.append(self.stage)

    def trouble(self, what: str) -> None:
        """Tell, at once and in the log, of something that went wrong and was mended."""
        self.troubles.append(what)
        nothing = {"losses": {}, "held_out_psnr": None, "rays_per_second": None}
        append_line(self._log, json.dumps(self.state() | nothing | {"trouble": what}))
        self.say(what)

    def say(self, what: str) -> None:
        """Tell at once of something that was found."""
        self._bar.console.print(what, markup=False, highlight=False)

    @contextmanager
    def apart(self) -> Iterator[None]:
        """A block between steps whose time says nothing of how long steps take."""
        begin = self.seconds
        yield
        self._last_apart = self.seconds - begin
        self._apart += self._last_apart

    def room_for(self, blocks: int) -> int:
        """How many blocks as long as the last `apart` fit into half of what is left of the stage,
        at most `blocks`; their time is kept for them."""
        left = max(self._stage_end - self.seconds, 0.0) / 2
        if self._last_apart:
            blocks = min(blocks, int(left / self._last_apart))
        self.reserved = blocks * self._last_apart
        return blocks

    @contextmanager
    def paused(self) -> Iterator[None]:
        """A block whose time does not count at all."""
        self._stopped = time.monotonic()
        yield
        spent, self._stopped = time.monotonic() - self._stopped, None
        self.begin, self._told, self._saved = (
            x + spent for x in (self.begin, self._told, self._saved)
        )

    def cut(self) -> str:
        """A line about the stages that time ended before their steps; empty if none was."""
        short = [
            (i + 1, made) for i, made in enumerate(self.made) if made < ALL and i not in self.early
        ]
        if not short:
            return ""
        stages = ", ".join(f"{made:.0%} in stage {i}" for i, made in short)
        return (
            f"time ended this training early: of the planned steps it made {stages}; "
            "more minutes give more quality"
        )

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
        if self.troubles:
            quality += f"{len(self.troubles)} troubles  "
        self._bar.update(
            self._task,
            completed=whole,
            description=f"stage {self.stage + 1}/{len(shares)}",
            facts=f"loss {sum(losses.values()):.4f}  {quality}"
            f"{rate / 1e3:.0f}k rays/s  {remaining / 60:.0f}:{remaining % 60:02.0f} left ",
        )


class Rehearsal:
    """A few steps through the whole schedule of a stage, off the record; in place of Progress."""

    def __init__(self, steps: int):
        self.stage, self.step, self._steps = 0, 0, steps

    def steps(self) -> Iterator[float]:
        """Progress through the stage in [0, 1), once a step."""
        while self.step < self._steps:
            yield self.step / self._steps
            self.step += 1

    def due(self) -> bool:
        return False

    checkpoint_due = due

    def state(self) -> dict:
        return {}

    def report(self, losses: dict[str, float], psnr: float | None) -> None: ...

    def shorten(self) -> None: ...

    def trouble(self, what: str) -> None: ...

    def abandon(self) -> None:
        self._steps = 0
