"""How ops scale: with a second thread, against what a second core is worth, and with their size.

    python benchmarks/scaling.py [--rounds 15] [--out benchmarks/results/scaling.json]

Forward and backward. One and two threads take turns in one process. What a second core is worth is
measured by two processes of one thread that run the same op at the same time: each would take as
long as one alone, were memory, caches and clock not shared. Sizes take turns, too; the exponent is
the slope of log time over log size, 1 for a cost that is linear.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median

import cases
import torch
import workers
from made import made
from ops import arguments_as, forward_backward

from lab.record import result_text

OPS: dict[str, Callable[[], cases.Case]] = {
    "composite": cases.composite,
    "sample_dense": lambda: cases.sample_dense(160),
    "shade_sg": cases.shade_sg,
    "mlp": lambda: cases.mlp(65_536, 28, 128, 128, 4),
    "occluded": cases.occluded,
    "adam_rows_": cases.adam_rows,
}
SIZES = [16_384, 65_536, 262_144]


def composite(samples: int) -> cases.Case:
    """The first rays of the case, of as many samples each."""
    case = cases.composite()
    alpha, value, offsets = case.arguments
    few = (a[:samples].detach().requires_grad_() for a in (alpha, value))
    return replace(case, arguments=(*few, offsets[: samples // cases.SAMPLES + 1]))


def sample_dense(points: int) -> cases.Case:
    """The first points of the case, in the same grid."""
    case = cases.sample_dense(160)
    sdf, features, where, *rest = case.arguments
    return replace(case, arguments=(sdf, features, where[:points], *rest))


BY_SIZE: dict[str, Callable[[int], cases.Case]] = {
    "composite, samples": composite,
    "sample_dense, points": sample_dense,
    "mlp, rows": lambda n: cases.mlp(n, 28, 128, 128, 4),
    "occluded, rays": lambda n: cases.occluded(n),
    "adam_rows_, rows": lambda n: cases.adam_rows(rows=n),
    "smooth_rows_, rows": lambda n: cases.smooth_rows(n),
}


def once(case: cases.Case) -> Callable[[], object]:
    """A run of a case, forward and backward."""
    return forward_backward(case.ours, arguments_as(case, torch.float32))


def threads(run: Callable[[], object], rounds: int) -> tuple[float, float]:
    """Median milliseconds on one and on two threads."""
    found: dict[int, list[float]] = {1: [], 2: []}
    for _ in range(rounds):
        for count, times in found.items():
            torch.set_num_threads(count)
            run()
            times.append(workers.milliseconds(run))
    return median(found[1]), median(found[2])


def copies(name: str, rounds: int) -> tuple[float, float]:
    """Median milliseconds on one thread, alone and beside a copy on another core."""
    context = multiprocessing.get_context("spawn")
    cores = sorted(os.sched_getaffinity(0))[:2]

    def measured(chosen: list[int]) -> float:
        queue, ready = context.Queue(), context.Barrier(len(chosen))
        own = [context.Process(target=_copy, args=(name, c, rounds, ready, queue)) for c in chosen]
        for process in own:
            process.start()
        times = [queue.get() for _ in own]
        for process in own:
            process.join()
        return sum(times) / len(times)

    return measured(cores[:1]), measured(cores)


def _copy(name: str, core: int, rounds: int, ready, queue) -> None:
    os.sched_setaffinity(0, {core})
    torch.set_num_threads(1)
    run = once(OPS[name]())
    run()
    ready.wait()
    queue.put(median(workers.milliseconds(run) for _ in range(3 * rounds)))


def growth(make: Callable[[int], cases.Case], rounds: int) -> dict[int, float]:
    """Median milliseconds by size."""
    runs = {n: once(make(n)) for n in SIZES}
    times: dict[int, list[float]] = {n: [] for n in SIZES}
    for _ in range(rounds):
        for n, run in runs.items():
            run()
            times[n].append(workers.milliseconds(run))
    return {n: median(t) for n, t in times.items()}


def exponent(times: dict[int, float]) -> float:
    x, y = ([math.log(v) for v in values] for values in (times.keys(), times.values()))
    mx, my = sum(x) / len(x), sum(y) / len(y)
    slope = sum((a - mx) * (b - my) for a, b in zip(x, y, strict=True))
    return slope / sum((a - mx) ** 2 for a in x)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=15)
    default = Path(__file__).parent / "results" / "scaling.json"
    parser.add_argument("--out", type=Path, default=default)
    options = parser.parse_args()
    result: dict = {"threads": {}, "growth": {}}
    print("| op | 1 thread, ms | 2 threads, ms | gain | one of two copies, ms | gain of a core |")
    print("|---|---|---|---|---|---|")
    for name, make in OPS.items():
        one, two = threads(once(make()), options.rounds)
        alone, beside = copies(name, options.rounds)
        result["threads"][name] = {"one": one, "two": two, "alone": alone, "beside": beside}
        values = (
            f"{one:.1f} | {two:.1f} | {one / two:.2f} | {beside:.1f} | {2 * alone / beside:.2f}"
        )
        print(f"| `{name}` | {values} |", flush=True)
    print("\n| op | " + " | ".join(f"{n:,}, ms" for n in SIZES) + " | exponent |")
    print("|---" * (len(SIZES) + 2) + "|")
    torch.set_num_threads(2)
    for name, make in BY_SIZE.items():
        times = growth(make, options.rounds)
        result["growth"][name] = {"ms": times, "exponent": exponent(times)}
        row = " | ".join(f"{t:.1f}" for t in times.values())
        print(f"| `{name}` | {row} | {exponent(times):.2f} |", flush=True)
    options.out.write_text(result_text(made() | result))


if __name__ == "__main__":
    main()
