"""The schedule of training steps under a time limit."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

from univoxel.config import PREPARATION, JointConfig, StageConfig, TrainConfig

RESERVE_SECONDS = 4.0  # of the limit, kept for the last checkpoint and the preview
LEAST = 0.5  # of its share of the rest of a limit that every stage gets, whatever came before
PACE = 0.1  # weight of the newest step in the mean time of a step
UNSURE = 4  # first steps of a stage, whose time is no measure for the others
# Share of the expected time of all steps that counts beside what was measured
UNMEASURED = 0.02
REST = 0.3  # of the steps that are left to a stage that is shortened: for its rates to fall
HURRY = 0.15  # of the time that is left to a training that is stopped, for the rest of its schedule
HURRY_SECONDS = 8.0  # and at least so much, if it is left: for some light and materials
FEWEST = 0.02  # share of a stage's steps below which their time tells nothing of all of them
ALL = 0.995  # share of the planned steps from which on a stage was not cut


# Seconds on two quiet cores of a Xeon with AVX-512, as a fast training on 60 photographs of 1152
# pixels was seen to take: of a step, of a ray of a step, and how many times as long a refit's take.
# On rendered photographs of 400 pixels, where fewer rays meet the object, it is two thirds of that
STEP, RAY, REFIT = 0.005, 26e-6, 1.4
JOINT, OBSERVATION = 0.020, 12e-6  # of a step of the joint solve, of an observation of a step


def expected_seconds(stage: StageConfig | JointConfig) -> float:
    """What the steps of a stage take on two quiet cores, about."""
    if isinstance(stage, JointConfig):
        return stage.iterations * (JOINT + OBSERVATION * stage.rays)
    return stage.iterations * (STEP + RAY * stage.rays) * (REFIT if stage.refit else 1.0)


def stage_name(stages: Sequence[StageConfig | JointConfig], index: int) -> str:
    """What a stage of a training is for, in a few words."""
    stage = stages[index]
    if isinstance(stage, JointConfig):
        return "materials and light"
    if stage.refit:
        return "polish"
    return "coarse shape" if index == 0 and len(stages) > 1 else "shape"


class StepClock(Protocol):
    """What the training loop asks of a clock: a schedule of steps, and where it is."""

    @property
    def stage(self) -> int:
        """Number of the present stage, from 0."""
        ...

    @property
    def step(self) -> int:
        """Steps that were made, over all stages."""
        ...

    def steps(self) -> Iterator[float]:
        """Progress through the stage in [0, 1), once a step."""
        ...

    def shorten(self) -> None:
        """Run through the rest of the stage's schedule in fewer steps."""
        ...

    def abandon(self) -> None:
        """End the stage, between steps."""
        ...


class Clock:
    """A whole run: its steps, and its time from the first photograph on.

    Without a limit every stage makes all its steps, however long that takes. Under a limit every
    stage gets its share of the time that is left, and at least `LEAST` of what it would have had
    after a preparation of usual length, so that none ends up with nothing. A stage that is cut
    makes fewer steps and still runs through the whole of its schedule, which follows `steps`.
    """

    def __init__(
        self, cfg: TrainConfig, begin: float, state: dict[str, Any], slower: float = 1.0
    ) -> None:
        """
        Args:
            begin: of reading the photographs, by `time.monotonic`.
            state: as `state` gave it; empty at the start of a run.
            slower: how many times as long a step takes here as on the machine of the estimates.
        """
        self.cfg: TrainConfig = cfg
        self.begin: float = begin
        self.limit: float = math.inf if cfg.minutes is None else 60 * cfg.minutes  # seconds
        self.finished: bool = state.get("finished", False)  # by hand, see `finish`
        self.stage: int = state.get("stage", 0)
        self.done: float = state.get("progress", 0.0)  # of the present stage, in [0, 1]
        self.step: int = state.get("step", 0)
        self.made: list[float] = list(state.get("made", ()))  # share of its steps, by ended stage
        self.early: list[int] = list(state.get("early", ()))  # numbers of shortened stages
        self.took: list[float] = list(state.get("took", ()))  # seconds, by ended stage
        self.watch: Callable[[], None] | None = None  # called between steps; its time is no time
        self.reserved: float = 0.0  # seconds of this stage that are kept for blocks off the pace
        self._stopped: float | None = None  # when the clock was, see `stopped`
        self._stage_steps: int = state.get("stage_steps", 0)  # made in the present stage
        self._planned, self._count = 0, 0  # steps of the stage in this sitting
        self._stage_begin = self.seconds  # of the stage in this sitting
        self._stage_before: float = state.get("stage_took", 0.0)  # seconds of it in earlier ones
        self._stage_end = 0.0  # when its time is over
        self._off_pace, self._last_block = 0.0, 0.0  # seconds, see `off_pace`
        self._in_rounds = False  # whether the present stage has blocks off the pace
        self._expected = [slower * expected_seconds(stage) for stage in cfg.stages]
        self.preparation: float = 0.0  # seconds that preparation is expected to end at
        self.afterwards: float = 0.0  # seconds of what follows the last stage: texture and page

    def state(self) -> dict[str, Any]:
        """What a later sitting needs to continue; JSON."""
        return {
            "stage": self.stage,
            "progress": self.done,
            "step": self.step,
            "made": self.made,
            "early": self.early,
            "stage_steps": self._stage_steps,
            "took": self.took,
            "stage_took": self.stage_took,
            "finished": self.finished,
            "seconds": self.seconds,
        }

    @property
    def seconds(self) -> float:
        """Time of the run so far, over all sittings: reading, preparation and training."""
        now = time.monotonic() if self._stopped is None else self._stopped
        return now - self.begin

    @property
    def stage_took(self) -> float:
        """Seconds of the present stage so far, over all sittings, with what came before its steps:
        the choice of sizes after the stage before."""
        return self._stage_before + self.seconds - self._stage_begin

    @property
    def over(self) -> bool:
        """Whether the time is up."""
        return self.seconds >= self.limit - RESERVE_SECONDS

    @property
    def pace(self) -> float:
        """Share of its steps that the stage before made, if time cut it short; else 1."""
        last = self.stage - 1
        return self.made[last] if 0 <= last < len(self.made) and last not in self.early else 1.0

    def prepared(self) -> None:
        """Note that the first stage begins now: what was before was reading and preparation."""
        self._stage_begin, self.preparation = self.seconds, 0.0

    @property
    def planned(self) -> float:
        """Seconds that the steps of all stages are expected to take."""
        return sum(self._expected)

    @property
    def hurried(self) -> bool:
        """Whether reading and preparation have had their part of a limit."""
        return self.seconds >= PREPARATION * self.limit

    @property
    def remaining(self) -> float:
        """Seconds until the end, about: what stages are expected to take, as measured so far, and
        what follows them."""
        measured = sum(self.took) + self.done * self.stage_took
        ended = self.stage if len(self.took) == self.stage else 0  # of a run of an older version
        expected = sum(self._expected[:ended])
        if self.stage < len(self._expected):
            expected += self.done * self.done * self._expected[self.stage]
        # Little was measured at first: then the estimate counts
        unsure = UNMEASURED * sum(self._expected)
        slower = (measured + unsure) / (expected + unsure)
        left = (1 - self.done) * sum(self._expected[self.stage : self.stage + 1])
        seconds = slower * (left + sum(self._expected[self.stage + 1 :])) + RESERVE_SECONDS
        seconds += max(self.preparation - self.seconds, 0.0)
        shares = [stage.share for stage in self.cfg.stages]
        begun = sum(shares[: self.stage]) + self.done * sum(shares[self.stage : self.stage + 1])
        least = LEAST * (1 - PREPARATION) * self.limit * (1 - begun / sum(shares))
        if math.isfinite(self.limit):
            seconds = min(seconds, max(self.limit - self.seconds, least))
        return seconds + self.afterwards

    @property
    def work_done(self) -> float:
        """Share of the expected work of the stages that is done, in [0, 1]."""
        done = sum(self._expected[: self.stage])
        done += self.done * sum(self._expected[self.stage : self.stage + 1])
        return done / self.planned

    @property
    def share_done(self) -> float:
        """Of the whole run, in [0, 1], by time."""
        return self.seconds / max(self.seconds + self.remaining, 1e-9)

    def steps(self, off_pace: float = 0.0) -> Iterator[float]:
        """Progress through the present stage in [0, 1), once a step; then the next stage is on.

        What is left of the schedule is spread over the steps that are left: those that were
        planned, or as many as fit into the stage's time as steps went lately.

        Args:
            off_pace: share of the stage's time, a guess, that passes under `off_pace`.
        """
        self._plan(off_pace)
        pace = 0.0  # seconds a step
        while self.done < 1 and (begin := self.seconds) < self._stage_end:
            before = self._off_pace
            yield self.done
            spent = self.seconds - begin - (self._off_pace - before)
            pace = spent if self._count == 0 else (1 - PACE) * pace + PACE * spent
            self.step, self._stage_steps = self.step + 1, self._stage_steps + 1
            self._count += 1
            steps_left = self._planned - self._count + 1  # with the one that was made
            if math.isfinite(self._stage_end):
                room = self._stage_end - self.seconds - self.reserved
                if self._count > UNSURE and room < pace * (steps_left - 1):
                    steps_left = 1 + room / pace if room > 0 else 1
            self.done += (1 - self.done) / max(steps_left, 1)
            if self.done > 1 - 1e-9:
                self.done = 1.0
            if self.watch:
                with self.stopped():
                    self.watch()
        self.skip()

    def _plan(self, off_pace: float) -> None:
        """How many steps are left of the stage, and when its time is over."""
        stage = self.cfg.stages[self.stage]
        self._planned, self._count = max(1, round((1 - self.done) * stage.iterations)), 0
        self._in_rounds = off_pace > 0
        allowed = self._allowed(max(self.limit - RESERVE_SECONDS - self._stage_begin, 0.0))
        shares = sum(s.share for s in self.cfg.stages)
        usual = (1 - PREPARATION) * self.limit * (1 - self.done) * stage.share / shares
        if not self.finished:  # what came between the stages may have taken long
            allowed = max(allowed, self.seconds - self._stage_begin + LEAST * usual)
        self._stage_end = self._stage_begin + allowed
        self.reserved = off_pace * allowed if off_pace else 0.0

    def _allowed(self, left: float) -> float:
        """Of so many seconds, those for the rest of the present stage."""
        stages = self.cfg.stages[self.stage :]
        shares = [(1 - self.done) * stages[0].share, *(s.share for s in stages[1:])]
        if math.isinf(left):
            return left
        return left * shares[0] / max(sum(shares), 1e-9)

    def skip(self) -> None:
        """Leave the present stage as it is for the next."""
        self.made.append(self._stage_steps / self.cfg.stages[self.stage].iterations)
        self.took.append(self.stage_took)
        self.stage, self.done, self._stage_steps = self.stage + 1, 0.0, 0
        self._stage_begin, self._stage_before = self.seconds, 0.0

    def shorten(self) -> None:
        """Run through the rest of the stage's schedule in fewer steps."""
        self._planned = self._count + math.ceil(REST * (self._planned - self._count))
        self.early.append(self.stage)

    def abandon(self) -> None:
        """Leave the present stage, between steps, with what it has."""
        self.done = 1.0
        self.early.append(self.stage)

    def finish(self) -> None:
        """Run through the rest of the schedule in a fraction of the time that is left: without the
        stages to come materials and light would lack. A stage of rounds is left as it is."""
        if self.finished:
            return
        left = min(self.limit - RESERVE_SECONDS - self.seconds, self.remaining - self.afterwards)
        left = max(left, 0.0)
        hurried = min(left, max(HURRY * left, HURRY_SECONDS))
        self.limit, self.finished = self.seconds + hurried + RESERVE_SECONDS, True
        if self._in_rounds:  # one may take longer than all that is left
            self.done = 1.0
        self._stage_end = self.seconds + self._allowed(hurried)

    @contextmanager
    def off_pace(self) -> Iterator[None]:
        """A block between steps whose time says nothing of how long steps take."""
        begin = self.seconds
        yield
        self._last_block = self.seconds - begin
        self._off_pace += self._last_block

    def blocks_that_fit(self, blocks: int) -> int:
        """How many blocks as long as the last under `off_pace` fit into half of what is left of
        the stage, at most `blocks`; their time is kept for them."""
        if math.isinf(self._stage_end):
            return blocks
        left = max(self._stage_end - self.seconds, 0.0) / 2
        if self._last_block:
            blocks = min(blocks, int(left / self._last_block))
        self.reserved = blocks * self._last_block
        return blocks

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """A block whose time does not count at all."""
        self._stopped = time.monotonic()
        try:
            yield
        finally:
            spent, self._stopped = time.monotonic() - self._stopped, None
            self.begin += spent

    def short(self) -> dict[str, float]:
        """Shares of their steps that stages made which ended before all, by time or by hand."""
        return {
            stage_name(self.cfg.stages, i): made
            for i, made in enumerate(self.made)
            if made < ALL and i not in self.early
        }

    def cut(self) -> str:
        """A line about the stages that ended before their steps, by time or by hand; empty if none
        did."""
        if not (short := self.short()):
            return ""
        stages = ", ".join(f"{made:.0%} of {name}" for name, made in short.items())
        why = "training was stopped early" if self.finished else "training ended at the time limit"
        return f"{why} (completed steps: {stages})"

    def minutes_for_all(self) -> float:
        """Minutes in which all steps would have been made, as those that were made went."""
        seconds = self.seconds
        for made, took in zip(self.made, self.took, strict=False):
            seconds += took * (1 / max(made, FEWEST) - 1) if made < ALL else 0.0
        return seconds / 60
