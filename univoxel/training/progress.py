"""Progress of a training: bar, log, messages, saved state, and choices of compression."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from typing import Any, Literal, Protocol, TypeAlias

import torch
from rich.progress import BarColumn, TextColumn

from univoxel.config import TrainConfig
from univoxel.core import log
from univoxel.core.files import append_line
from univoxel.core.progress_bar import bar
from univoxel.core.system import peak_memory_mb
from univoxel.training.clock import Clock, StepClock, stage_name

# Runs of version 0.2 and before may have channels, lobes and hidden units too
Kind: TypeAlias = Literal["voxels", "mirror levels", "reach", "rows"]


@dataclass(frozen=True)
class CapacityChoice:
    """The size that was chosen for one kind of capacity."""

    kind: Kind
    before: float  # size; of a reach in voxels, else a count
    after: float
    cost: float  # dB that validation pixels lost; below 0 they gained
    why: str

    @property
    def sentence(self) -> str:
        """The choice in words, for people."""
        return f"{self.kind} {self.before:,.9g} -> {self.after:,.9g}: {self.why}"

    def as_json(self) -> dict[str, Any]:
        """The choice as an entry of a run's state."""
        values = asdict(self)
        return {"what": values.pop("kind"), **values, "said": self.sentence}

    @staticmethod
    def from_json(entry: dict[str, Any]) -> CapacityChoice:
        """The choice that `as_json` wrote."""
        names = ("what", "before", "after", "cost", "why")
        return CapacityChoice(*(entry[name] for name in names))


def chosen_voxels(choices: Iterable[CapacityChoice]) -> int | None:
    """Voxels of the coarsest grid that was chosen; None if none was."""
    counts = [round(choice.after) for choice in choices if choice.kind == "voxels"]
    return min(counts, default=None)


def chosen_reach(choices: Iterable[CapacityChoice]) -> float | None:
    """Voxels from the surface up to which nodes are stored, as chosen last; None if it was
    not."""
    reaches = [choice.after for choice in choices if choice.kind == "reach"]
    return reaches[-1] if reaches else None


# What a training tells of itself: bar, log, messages, and the state that it is saved with.


LOG = "log.jsonl"  # in the folder of a run
REPORT_SECONDS = 5.0
CHECKPOINT_SECONDS = 20.0  # of work that a kill costs, about


@dataclass(frozen=True)
class TrainingProgress:
    """The progress of a training run."""

    stage: int  # number of the stage, starting at 1
    stages: int  # number of stages
    name: str  # name of the stage, such as "shape"
    share: float  # progress of the whole run, in [0, 1]
    seconds: float  # training time so far
    remaining: float  # estimated remaining seconds
    losses: dict[str, float]  # weighted losses, by name
    held_out_psnr: float | None  # PSNR of validation pixels, dB; None: not measured in this call
    rays_per_second: float


class Listener(Protocol):
    """What the training loop tells, and asks: a clock, and whether it is time to report."""

    @property
    def clock(self) -> StepClock: ...

    def due(self) -> bool:
        """Whether it is time to report."""
        ...

    def report(self, losses: dict[str, float], psnr: float | None) -> None: ...

    def checkpoint_due(self) -> bool:
        """Whether a checkpoint is due, for a run that may be killed."""
        ...

    def state(self) -> dict[str, Any]:
        """What a checkpoint holds beside the scene; JSON."""
        ...

    def trouble(self, what: str) -> None:
        """Tell of something that went wrong and was repaired."""
        ...


class Progress:
    """A run on a clock, with a bar and a log in its folder. Used in a `with` block."""

    def __init__(
        self,
        cfg: TrainConfig,
        begin: float,
        state: dict[str, Any],
        on_progress: Callable[[TrainingProgress], None] | None = None,
        slower: float = 1.0,
    ):
        """
        Args:
            begin: of reading the photographs, on the clock of `time.monotonic`.
            state: as `state` gave it; empty at the start of a run.
            on_progress: called with each report.
            slower: as in `Clock`.
        """
        self.cfg: TrainConfig = cfg
        self.slower: float = slower
        self.clock: Clock = Clock(cfg, begin, state, slower)
        self._goes_on = bool(state)
        # Steps of the preparation that a limit left no time for: those that go on leave them, too
        self.skipped: list[str] = list(state.get("skipped", ()))
        self._on_progress = on_progress
        self.chosen: list[CapacityChoice] = [
            CapacityChoice.from_json(entry) for entry in state.get("chosen", ())
        ]
        self.troubles: list[str] = list(state.get("troubles", ()))  # what went wrong and was mended
        # Where a stage of rounds is in them; JSON, None in others
        self.within: dict[str, Any] | None = state.get("within")
        self._log = cfg.out / LOG
        self._reported, self._reported_step = self.clock.seconds, self.clock.step
        self._saved = self.clock.seconds
        self._bar = bar(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:3.0f} %  {task.fields[facts]}"),
        )
        self._task = self._bar.add_task("", total=1.0, facts="")

    def __enter__(self) -> Progress:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def preparing(self, what: str, needed: bool = False) -> bool:
        """Tell of a step of the preparation; whether it is to be made.

        Args:
            needed: it is. Others are left out where a limit leaves no time for them.
        """
        self._show(f"preparation: {what}", "")
        if not needed and self.clock.hurried and not self._goes_on:
            self.skipped.append(what)
            log.info(
                f"the limit minutes is too short, so a step of the preparation is skipped: {what}",
                extra={"arguments": ("minutes",)},
            )
        return what not in self.skipped

    def prepared(self) -> None:
        """Let the first stage begin."""
        self.clock.prepared()
        self._reported = self._saved = self.clock.seconds

    def _show(self, what: str, facts: str) -> None:
        """Move the bar."""
        times = f"{_clock(self.clock.seconds)} elapsed, {_clock(self.clock.remaining)} left "
        self._bar.update(
            self._task, completed=self.clock.share_done, description=what, facts=facts + times
        )

    def state(self) -> dict[str, Any]:
        """What a later sitting needs to continue, and what evaluation reports; JSON."""
        return self.clock.state() | {
            "within": self.within,
            "chosen": [choice.as_json() for choice in self.chosen],
            "troubles": self.troubles,
            "skipped": self.skipped,
            "threads": torch.get_num_threads(),
            "peak_rss_mb": peak_memory_mb(),
        }

    def say(self, what: str) -> None:
        """Tell at once of something that was found."""
        log.info(what)

    def trouble(self, what: str) -> None:
        """Tell, at once and in the log, of something that went wrong and was repaired."""
        self.troubles.append(what)
        nothing = {"losses": {}, "held_out_psnr": None, "rays_per_second": None}
        self._append(self.state() | nothing | {"trouble": what})
        self.say(what)

    def _append(self, line: dict[str, Any]) -> None:
        append_line(self._log, json.dumps(line))

    def due(self) -> bool:
        """Whether it is time to report."""
        return self.clock.seconds - self._reported > REPORT_SECONDS

    def checkpoint_due(self) -> bool:
        """Whether a checkpoint is due, for a run that may be killed."""
        if self.clock.seconds - self._saved < CHECKPOINT_SECONDS:
            return False
        self._saved = self.clock.seconds
        return True

    def report(self, losses: dict[str, float], psnr: float | None) -> None:
        """Move the bar and append a line to the log."""
        clock = self.clock
        now, stage = clock.seconds, self.cfg.stages[clock.stage]
        rate = (clock.step - self._reported_step) * stage.rays / (now - self._reported)
        self._reported, self._reported_step = now, clock.step
        name = stage_name(self.cfg.stages, clock.stage)
        done, remaining = clock.share_done, clock.remaining
        line = self.state() | {"losses": losses, "held_out_psnr": psnr, "rays_per_second": rate}
        self._append(line | {"share": done, "name": name})
        if self._on_progress is not None:
            place = clock.stage + 1, len(self.cfg.stages), name, done, now, remaining
            with clock.stopped():  # its time is the caller's affair
                self._on_progress(TrainingProgress(*place, losses, psnr, rate))
        quality = "" if psnr is None else f"validation {psnr:.1f} dB  "
        if self.troubles:
            quality += f"recovered {len(self.troubles)} times  "
        self._show(f"{name} ({clock.stage + 1} of {len(self.cfg.stages)})", quality)


def _clock(seconds: float) -> str:
    """Minutes and seconds, such as 2:05."""
    return f"{round(seconds) // 60}:{round(seconds) % 60:02d}"
