"""Where the seconds of a whole training go, by its stages and by what is done in them.

    python benchmarks/profile_run.py SCENE [--preset fast] [--part 6] [--cpu]

`univoxel.cli.trainer` itself runs; what it calls is timed where it is called. Of every 16th
backward pass the profiler says which part of the forward pass its nodes belong to; the time of all
of them is divided in these proportions.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from made import made
from train_step import OTHER, STAGES, Clock

from lab.record import result_text
from univoxel.cli import trainer
from univoxel.config import JointConfig, StageConfig, TrainConfig
from univoxel.fields.field import Field
from univoxel.ops import VisibilityScene
from univoxel.preparation import prepare
from univoxel.presets import chosen
from univoxel.render import observations
from univoxel.training import joint_solve, loop, patches

HERE = Path(__file__).parent
ONCE = {
    "joint: observations and visibility": [(joint_solve, "build_problem")],
    "joint: hypothesis trials": [(joint_solve, "initialise_")],
    "joint: entropy": [
        (joint_solve, name) for name in ("fit_sun_", "minimise_entropy_", "diffuse_albedo")
    ],
    "joint: Newton": [(joint_solve, "newton_round_")],
    "joint: metal decision": [(joint_solve, "find_metal")],
    "held-out rays": [(loop, "held_out_psnr")],
    "previews": [(trainer, "preview")],
    "checkpoints": [(trainer, "save_scene"), (loop, "save_scene")],
    "trust": [(trainer, "save_trust")],
}  # seconds of a stage whatever the number of its steps
EVERY = 16  # backward passes of which one is divided
START = "before"  # loading, hull; also what lies between the stages
PARTS = {
    **STAGES,
    "sample": [(Field, n) for n in ("sample", "features_at")],
    "light": [*STAGES["light"], (observations, "shade_map")],
    "hull": [(prepare, name) for name in ("fitted_masks", "choose_masks_or_poses", "visual_hull")],
    "carving": [(prepare, "carve_within_time")],
    "cameras": [(prepare, "registered_poses")],
    "loading": [(trainer, "load_photos")],
    "mesh for rays": [(VisibilityScene, "__init__")],
    "patches": [(patches, "comparable"), (patches, "disagreement")],
    **ONCE,
}


class RunClock(Clock):
    """A clock for a whole training: it starts again with every stage."""

    def __init__(self, cfg: TrainConfig, now: Callable[[], float]) -> None:
        super().__init__(now)
        self.cfg, self.columns, self.begin = cfg, {}, now()
        self.steps, self.spent = 0, 0.0  # backward passes and their seconds
        self._once = False  # whether a part of ONCE runs, which includes what it calls

    def timed(self, name: str, function):
        timed = super().timed(name, function)

        def call(*arguments, **options):
            if self._once:
                return function(*arguments, **options)
            self._once = name in ONCE
            try:
                return timed(*arguments, **options)
            finally:
                self._once = False

        return call

    def enter(self, title: str) -> None:
        """Book what was measured to a column and start again."""
        whole = self.now() - self.begin
        rows = defaultdict(float, self.forward)
        divided = sum(self.backward.values())
        for name, seconds in self.backward.items():
            rows[f"{name}, backward"] += self.spent * seconds / divided
        rows[OTHER] += whole - sum(rows.values())
        old = self.columns.setdefault(title, {"seconds": 0.0, "steps": 0, "rows": {}})
        old["seconds"] += whole
        old["steps"] += self.steps
        for name, seconds in rows.items():
            old["rows"][name] = old["rows"].get(name, 0.0) + seconds
        self.forward.clear()
        self.backward.clear()
        self.begin, self.steps, self.spent = self.now(), 0, 0.0

    def stage(self, function):
        """A stage's function as a column of its own."""

        def call(*arguments):
            progress = arguments[-1]
            number, stage = progress.clock.stage + 1, self.cfg.stages[progress.clock.stage]
            joint = isinstance(stage, JointConfig)
            what = "joint" if joint else f"{'refit' if stage.refit else 'grid'} {stage.voxels:g} M"
            self.enter(START)
            self._inner.append(0.0)
            try:
                return function(*arguments)
            finally:
                self._inner.pop()
                self.enter(f"{number}: {what}")

        return call

    def backward_pass(self, function):
        def call(*arguments, **options):
            divide = self.steps % EVERY == 0
            begin = self.now()
            with torch.autograd.profiler.profile(enabled=divide) as events:
                result = function(*arguments, **options)
            if divide:
                self.add_backward(events.function_events)
            self._ranges.clear()
            seconds = self.now() - begin
            self._inner[-1] += seconds
            if divide and self.steps:  # what the profiler itself took is no part of the training
                usual = self.spent / self.steps
                self.begin += seconds - usual
                seconds = usual
            self.spent += seconds
            self.steps += 1
            return result

        return call


def profile(cfg: TrainConfig, now: Callable[[], float] = time.perf_counter) -> dict:
    """Seconds by stage and part of one training."""
    clock, originals = RunClock(cfg, now), []

    def patch(owner, attribute, wrap):
        original = getattr(owner, attribute)
        originals.append((owner, attribute, original))
        setattr(owner, attribute, wrap(original))

    for name, places in PARTS.items():
        for owner, attribute in places:
            patch(owner, attribute, lambda f, name=name: clock.timed(name, f))
    patch(torch.Tensor, "backward", clock.backward_pass)
    patch(trainer, "run_stage", clock.stage)
    patch(joint_solve, "solve", clock.stage)
    begin = now()
    try:
        trainer.train(cfg)
        clock.enter(START)
    finally:
        for owner, attribute, original in originals:
            setattr(owner, attribute, original)
    return {"seconds": now() - begin, "stages": clock.columns}


def part_of(stage: StageConfig | JointConfig, part: int) -> StageConfig | JointConfig:
    """A stage with an n-th of its steps."""
    stage = replace(stage, iterations=stage.iterations // part)
    if not isinstance(stage, JointConfig):
        return stage
    steps = max(1, stage.entropy.teaching_steps // part)
    return replace(stage, entropy=replace(stage.entropy, teaching_steps=steps))


def extrapolated(columns: dict, part: int) -> dict:
    """Columns of a run with an n-th of its steps as if it had made all of them."""
    found = {}
    for title, column in columns.items():
        rows = {
            name: seconds * (1 if title == START or name in ONCE else part)
            for name, seconds in column["rows"].items()
        }
        found[title] = {
            "seconds": sum(rows.values()),
            "steps": part * column["steps"],
            "rows": rows,
        }
    return found


def table(result: dict) -> str:
    """Markdown, seconds; what is below half a per cent of the whole goes into other."""
    stages = extrapolated(result["stages"], result["part"])
    names = dict.fromkeys(name for s in stages.values() for name in s["rows"])
    whole = sum(s["seconds"] for s in stages.values())
    sums = {n: sum(s["rows"].get(n, 0.0) for s in stages.values()) for n in names}
    shown = sorted((n for n in names if sums[n] > 0.005 * whole and n != OTHER), key=sums.get)
    order = sorted(stages, key=lambda title: (title != START, title))
    lines = [
        f"| | {' | '.join(order)} | whole | share |",
        "|---|" + "---:|" * (len(order) + 2),
    ]

    def line(name, cells):
        text = " | ".join(f"{c:.1f}" if c >= 0.05 else "" for c in cells)
        lines.append(f"| {name} | {text} | {sum(cells):.1f} | {sum(cells) / whole:.0%} |")

    for name in reversed(shown):
        line(name, [stages[t]["rows"].get(name, 0.0) for t in order])
    rest = [stages[t]["seconds"] - sum(stages[t]["rows"].get(n, 0.0) for n in shown) for t in order]
    line(OTHER, rest)
    line("whole", [stages[t]["seconds"] for t in order])
    steps = " | ".join(f"{stages[t]['steps'] or ''}" for t in order)
    lines.append(f"| steps | {steps} | {sum(s['steps'] for s in stages.values())} | |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, help="folder of photographs")
    parser.add_argument("--preset", default="fast", help="such as draft (default: fast)")
    parser.add_argument("--minutes", type=float, help="limit (default: the preset's)")
    parser.add_argument(
        "--cpu", action="store_true", help="processor time: for one thread on a busy machine"
    )
    parser.add_argument(
        "--part", type=int, default=1, help="make an n-th of the steps and multiply (default: 1)"
    )
    parser.add_argument("--threads", type=int, default=1, help="of all kernels (default: 1)")
    parser.add_argument("--out", type=Path, default=HERE / "results" / "profile.json")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    with tempfile.TemporaryDirectory() as folder:
        cfg = chosen(options.preset, options.minutes, options.scene, Path(folder) / "run")
        stages = (part_of(s, options.part) for s in cfg.stages)
        cfg = replace(cfg, stages=tuple(stages), capacity="fixed")  # what chooses is no stage
        result = profile(cfg, time.process_time if options.cpu else time.perf_counter)
    result |= {
        "scene": options.scene.name,
        "preset": options.preset,
        "part": options.part,
        "clock": "processor" if options.cpu else "wall",
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "load_average": os.getloadavg()[0],
    }
    options.out.write_text(result_text(made() | result))
    print(table(result))


if __name__ == "__main__":
    main()
