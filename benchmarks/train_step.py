"""Where a training step's time goes, stage by stage, with the kernels and with the references.

    python benchmarks/train_step.py [--rays 4096] [--out benchmarks/results/train_step.json]

The bundled scene is trained natively for some steps, then the loop of univoxel.cli.trainer itself
runs on, once on each backend: its stages are timed where they are called. With the kernels the
backward pass is divided too: a node belongs to the stage in which its forward was called. The
references' is not: under the profiler that this takes their memory grew past 20 GB.
"""

from __future__ import annotations

import argparse
import os
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import torch
from made import made

from lab.record import result_text
from univoxel import ops
from univoxel.data import load_photos
from univoxel.fields.field import Field, MaterialHead, RadianceHead, dense_field
from univoxel.fields.grid import fit_grid
from univoxel.lights import base
from univoxel.lights.base import MirroredLight
from univoxel.lights.sg import LocalSG
from univoxel.optim import RowAdam
from univoxel.preparation.hull import estimate_bounds, mask_distances, visual_hull
from univoxel.presets import preset
from univoxel.render import metrics
from univoxel.scene import Scene
from univoxel.training import loop
from univoxel.training.pixels import TrainingPixels, split_pixels

HERE = Path(__file__).parent
DATA = HERE.parent / "univoxel" / "example_data" / "tiny"
STAGES = {
    "rays": [(loop, "batch_at")],
    "march": [(Field, "march")],
    "sample and composite": [(Field, "composite")],
    "sums of gradients": [(loop, "add_gradient_")],
    "heads": [
        *((head, "forward") for head in (MaterialHead, RadianceHead, MirroredLight)),
        (LocalSG, "raw"),
    ],
    "light": [(LocalSG, "reflected"), (LocalSG, "lobes_from_raw")],
    "losses": [
        *((metrics, name) for name in ("photometric", "silhouette")),
        *((base, name) for name in ("smoothness", "chroma", "total_variation")),
    ],
    "optimiser": [(RowAdam, "step")],
    "smoothing": [(loop.descent, "smooth_touched_"), (loop.descent, "smooth_sdf_gradient_")],
    "refresh": [(Field, "refresh")],
}
BACKWARD = "backward"
OTHER = "other"  # surfaces of what was composited, gradients of what is used twice
COUNT = {"native": 32, "reference": 4}  # steps: of 16, one refreshes and four smooth


class Clock:
    """Seconds by stage, forward and backward, of every call between `start` and `stop`."""

    def __init__(self, now: Callable[[], float] = time.perf_counter) -> None:
        self.now = now
        self.forward: dict[str, float] = defaultdict(float)
        self.backward: dict[str, float] = defaultdict(float)
        self._inner = [0.0]  # seconds in stages called from the present one
        self._ranges: list[tuple[int, int, str]] = []  # numbers of the nodes a stage made

    def timed(self, name: str, function):
        def call(*arguments, **options):
            number = torch._C._autograd._get_sequence_nr
            first, begin = number(), self.now()
            self._inner.append(0.0)
            try:
                return function(*arguments, **options)
            finally:
                seconds = self.now() - begin
                self.forward[name] += seconds - self._inner.pop()
                self._inner[-1] += seconds
                self._ranges.append((first, number(), name))

        return call

    def add_backward(self, events) -> None:
        """Sort the profiler's backward nodes into stages."""
        stage: dict[int, str] = {}
        for first, end, name in self._ranges:  # innermost ranges were noted first
            for number in range(first, end):
                stage.setdefault(number, name)
        for event in events:
            if event.name.startswith("autograd::engine::evaluate_function"):
                seconds = event.cpu_time_total / 1e6
                self.backward[stage.get(event.sequence_nr, OTHER)] += seconds


def hull_scene(voxels: float) -> tuple[Scene, TrainingPixels]:
    """The scene as training starts it, and the pixels it is trained on."""
    photos = load_photos(DATA, "train")
    distance = mask_distances(photos.coverage())
    lower, upper = estimate_bounds(distance, photos.cameras)
    grid = fit_grid(lower, upper, round(1e6 * voxels))
    cfg = preset("fast", DATA, DATA)
    field = dense_field(grid, cfg.scene.channels, visual_hull(distance, photos.cameras, grid))
    light = replace(cfg.scene.light, scale=float((upper - lower).max()) / 2)
    return Scene(replace(cfg.scene, light=light), field), split_pixels(photos, distance)


def run_steps(
    scene: Scene, pixels: TrainingPixels, rays: int, count: int, begin: float = 0.5
) -> None:
    """`count` steps of the training loop, with every term of the loss; `begin`: of its schedule."""
    cfg = preset("fast", DATA, DATA)
    stage = replace(cfg.stages[1], rays=rays, physical_from=0.0)
    clock = SimpleNamespace(stage=1, step=0)
    progress = SimpleNamespace(clock=clock, due=lambda: False, checkpoint_due=lambda: False)

    def steps():
        for i in range(count):
            clock.step = i
            yield begin + (1 - begin) * i / count

    clock.steps = steps
    loop.run_stage(scene, cfg, stage, pixels, progress)


def profile(scene: Scene, pixels: TrainingPixels, rays: int, count: int, divide: bool) -> dict:
    """Milliseconds a step, whole and by stage."""
    run_steps(scene, pixels, rays, 1)
    clock, originals = Clock(), []
    for name, places in (STAGES | {BACKWARD: [(torch.Tensor, "backward")]}).items():
        for owner, attribute in places:
            originals.append((owner, attribute, getattr(owner, attribute)))
            setattr(owner, attribute, clock.timed(name, originals[-1][2]))
    start = time.perf_counter()
    with torch.autograd.profiler.profile(enabled=divide) as events:
        run_steps(scene, pixels, rays, count)
    whole = time.perf_counter() - start
    for owner, attribute, original in originals:
        setattr(owner, attribute, original)
    clock.forward[OTHER] = whole - sum(clock.forward.values())
    backward = clock.forward.pop(BACKWARD)
    if divide:
        clock.add_backward(events.function_events)
        clock.backward[OTHER] += backward - sum(clock.backward.values())
    return {
        "step_ms": 1e3 * whole / count,
        "backward_ms": 1e3 * backward / count,
        "stages": {
            name: {
                "forward_ms": 1e3 * clock.forward[name] / count,
                "backward_ms": 1e3 * clock.backward[name] / count,
            }
            for name in (*STAGES, OTHER)
        },
    }


def table(result: dict) -> str:
    """Markdown."""
    native, reference = result["native"], result["reference"]
    lines = [
        "| stage | references, forward ms | kernels, forward ms | backward ms | share of step |",
        "|---|---|---|---|---|",
    ]
    for name, ms in native["stages"].items():
        share = 100 * sum(ms.values()) / native["step_ms"]
        lines.append(
            f"| {name} | {reference['stages'][name]['forward_ms']:.1f} | {ms['forward_ms']:.1f} | "
            f"{ms['backward_ms']:.1f} | {share:.0f} % |"
        )
    ratio = reference["backward_ms"] / native["backward_ms"]
    lines.append(
        f"| backward, whole | {reference['backward_ms']:.0f} | | {native['backward_ms']:.0f} | "
        f"{ratio:.0f} x faster |"
    )
    ratio = reference["step_ms"] / native["step_ms"]
    lines.append(
        f"| step, whole | {reference['step_ms']:.0f} | {native['step_ms']:.0f} | | "
        f"{ratio:.0f} x faster |"
    )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rays", type=int, default=4096, help="per step (default: 4096)")
    parser.add_argument("--voxels", type=float, default=1.0, help="millions (default: 1)")
    parser.add_argument("--warm-up", type=int, default=96, help="steps of training before")
    parser.add_argument("--threads", type=int, default=1, help="of all kernels (default: 1)")
    parser.add_argument("--out", type=Path, default=HERE / "results" / "train_step.json")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    torch.manual_seed(0)
    scene, pixels = hull_scene(options.voxels)
    run_steps(scene, pixels, options.rays, options.warm_up, begin=0.0)
    result = {
        "rays": options.rays,
        "grid": list(scene.field.grid.size),
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
    }
    for backend, count in COUNT.items():
        with ops.use_backend(backend):
            result[backend] = profile(scene, pixels, options.rays, count, backend == "native")
    result["load_average"] = os.getloadavg()[0]
    options.out.write_text(result_text(made() | result))
    print(table(result))


if __name__ == "__main__":
    main()
