"""What dense, sparse and hash fields cost as their resolution grows: memory, and time of a step.

    python benchmarks/field_scaling.py [--sizes 64 96 128 192 256 384 512] [--out FILE.json]

A bumpy ball, 0.9 of its box across, at 48^3 nodes is brought to size^3, and then fitted by steps of
training without heads: march, sample, composite, backward, gradient spread, Adam, smoothing, and a
look at the bricks every 16 steps. Every case is a process of its own; memory is the most that it
held resident, less what it held before the field was made. Exponents are slopes of log cost over
log size, of the four largest sizes. Dense grids stop where memory does (--most, in GB). A picture
is beside the JSON where matplotlib is there.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import subprocess
import sys
import time
from pathlib import Path
from statistics import median

import torch
from made import made

from lab.record import result_text
from univoxel.core.records import Rays
from univoxel.fields.field import PER_LEVEL, Field, Levels, dense_field, hash_field
from univoxel.fields.grid import GridShape
from univoxel.ops import composite, section_alpha
from univoxel.optim import RowAdam, rows_of
from univoxel.training import descent, loop

HERE = Path(__file__).parent
OUT = HERE / "results" / "field_scaling.json"
RAYS, COARSE = 2048, 48
KINDS = ("dense", "sparse", "hash")
SHARPNESS = 0.5  # s of the density, voxels


def cube(n: int) -> GridShape:
    return GridShape((-1.0,) * 3, 2 / (n - 1), (n, n, n))


def ball(channels: int) -> Field:
    grid = cube(COARSE)
    x = grid.nodes()
    bumps = 0.03 * (9 * x).sin().prod(-1)
    return dense_field(grid, channels, x.norm(dim=-1) - 0.87 + bumps)


def refined(coarse: Field, grid: GridShape, kind: str) -> Field:
    """The ball on a fine grid, on a field of a kind."""
    if kind == "sparse":
        return coarse.in_bricks(grid)
    if kind == "dense":
        return coarse.resized(grid)
    levels = Levels.of(grid.bounds(), grid.voxel_size, coarse.channels // PER_LEVEL)
    return hash_field(coarse.grid, levels, coarse.sdf.detach()).resized(grid)


def random_rays() -> Rays:
    """From all around at places within the ball."""
    origin = 3 * torch.nn.functional.normalize(torch.randn(RAYS, 3), dim=1)
    target = 0.85 * torch.nn.functional.normalize(torch.randn(RAYS, 3), dim=1)
    return Rays(origin, torch.nn.functional.normalize(target - origin, dim=1))


def step(field: Field, optimizer: RowAdam) -> None:
    """One step towards features that are the position, at sharp opacity."""
    channels = field.channels
    rays, inv_s = random_rays(), 1 / (SHARPNESS * field.voxel_size)
    samples = field.march(rays, torch.rand(RAYS), inv_s)
    ray = torch.repeat_interleave(samples.offsets.diff())
    points = rays.origin[ray] + samples.t[:, None] * rays.direction[ray]
    at = field.sample(points)
    alpha = section_alpha(at.sdf, samples.connected, inv_s)
    seen, _ = composite(alpha, torch.cat([at.features, at.gradient], 1), samples.offsets)
    wanted, _ = composite(alpha.detach(), points.repeat(1, 6)[:, :channels], samples.offsets)
    length = seen[:, channels:].square().sum(1)
    loss = (seen[:, :channels] - wanted).square().mean() + 0.1 * (length - 1).square().mean()
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    descent.smooth_sdf_gradient_(field, 4)
    optimizer.step()


def resident() -> float:
    """MB that this process has held at most."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def case(kind: str, size: int, channels: int, steps: int) -> dict:
    """One field at one resolution, in this process."""
    torch.manual_seed(0)
    coarse, grid = ball(channels), cube(size)
    step(coarse, RowAdam([coarse.sdf, coarse.features]))
    before, begin = resident(), time.perf_counter()
    field = refined(coarse, grid, kind)
    field.refresh()  # the first look brings what the surface's own bricks lack beside them
    made = time.perf_counter() - begin
    optimizer = RowAdam([field.sdf, field.features], lr=0.01 * field.voxel_size, eps=1e-4)
    seconds, looks = [], []
    for i in range(steps):
        if i % loop.REFRESH == 0:
            begin, old = time.perf_counter(), (field.sdf, field.features)
            field.refresh()
            for a, b in zip(old, (field.sdf, field.features), strict=True):
                optimizer.follow(a, b)
            looks.append(time.perf_counter() - begin)
        begin = time.perf_counter()
        step(field, optimizer)
        if i % loop.SMOOTH_EVERY == 0:
            assert field.sdf.grad is not None
            assert field.features.grad is not None
            touched, read = rows_of(field.sdf.grad), rows_of(field.features.grad)
            field.distances.smooth_rows_(field.sdf.detach(), touched, 0.01, order=2)
            field.smooth_features_(read, 0.01)
        seconds.append(time.perf_counter() - begin)
    peak = resident()
    begin = time.perf_counter()
    faces = len(field.isosurface()[1])
    return {
        "kind": kind,
        "size": size,
        "nodes": field.sdf.numel(),
        "memory_mb": peak - before,
        "process_mb": peak,
        "make_seconds": made,
        "step_ms": 1e3 * (median(seconds) + median(looks) / loop.REFRESH),
        "refresh_ms": 1e3 * median(looks),
        "isosurface_seconds": time.perf_counter() - begin,
        "faces": faces,
    }


def exponent(rows: list[dict], cost: str) -> float:
    """Slope of log cost over log size by least squares, of the four largest sizes."""
    rows = sorted(rows, key=lambda r: r["size"])[-4:]
    x = torch.tensor([math.log(r["size"]) for r in rows])
    y = torch.tensor([math.log(r[cost]) for r in rows])
    x = x - x.mean()
    return float((x * y).sum() / x.square().sum())


def draw(found: dict, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.ticker import LogLocator

    figure, axes = pyplot.subplots(1, 2, figsize=(9, 3.6))
    for axis, cost, label in zip(
        axes, ("memory_mb", "step_ms"), ("peak memory, MB", "a step, ms"), strict=True
    ):
        for kind, of_kind in found["exponents"].items():
            rows = [r for r in found["cases"] if r["kind"] == kind]
            axis.loglog(
                [r["size"] for r in rows],
                [r[cost] for r in rows],
                marker="o",
                label=f"{kind}, exponent {of_kind[cost]:.2f}",
            )
        sizes = sorted({r["size"] for r in found["cases"]})
        axis.set_xticks(sizes, [str(s) for s in sizes])
        axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))  # times span less than a decade
        axis.yaxis.set_major_formatter("{x:g}")
        axis.minorticks_off()
        axis.set_xlabel("nodes along a side")
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
        axis.legend()
    figure.tight_layout()
    for suffix in (".png", ".svg"):
        figure.savefig(path.with_suffix(suffix), dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[64, 96, 128, 192, 256, 384, 512])
    parser.add_argument("--channels", type=int, default=16)
    parser.add_argument("--steps", type=int, default=33)
    parser.add_argument("--most", type=float, default=5.0, help="GB that a dense grid may take")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--case", nargs=2, metavar=("KIND", "SIZE"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.case:
        print(
            json.dumps(case(options.case[0], int(options.case[1]), options.channels, options.steps))
        )
        return
    rows: list[dict] = []
    for size in options.sizes:
        for kind in KINDS:
            row = 3 * 4 * (1 + options.channels)  # bytes of a node: value and two moments
            if kind == "dense" and size**3 * row > options.most * 1e9:
                continue
            command = [sys.executable, __file__, "--steps", str(options.steps)]
            command += ["--channels", str(options.channels)]
            done = subprocess.run(
                [*command, "--case", kind, str(size)], capture_output=True, text=True, check=True
            )
            rows.append(json.loads(done.stdout.splitlines()[-1]))
            print(rows[-1], flush=True)
    costs = ("memory_mb", "step_ms", "nodes", "make_seconds")
    found = {
        "threads": torch.get_num_threads(),
        "cores": os.cpu_count(),
        "rays": RAYS,
        "channels": options.channels,
        "steps": options.steps,
        "cases": rows,
        "exponents": {
            kind: {c: exponent([r for r in rows if r["kind"] == kind], c) for c in costs}
            for kind in KINDS
        },
    }
    options.out.write_text(result_text(made() | found))
    print(json.dumps(found["exponents"], indent=2))
    try:
        draw(found, options.out)
    except ImportError:
        print("matplotlib is not installed: no picture")


if __name__ == "__main__":
    main()
