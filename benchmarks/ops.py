"""Time every op, forward and backward, against its reference, eager and compiled, and its peers.

    python benchmarks/ops.py [--only composite] [--rounds 11] [--out benchmarks/results/ops.json]

Each op is first held against its reference in float64. All contenders of a case run in turn, round
by round, so that a noisy machine treats them alike; compiled code and other packages do so in
processes of their own (workers.py). Timings on 1 and 2 threads come from different processes: not
every peer can change its threads. On 1 thread only the op and its eager reference run: they tell
how the op scales.
"""

from __future__ import annotations

import argparse
import functools
import json
import logging
import os
import platform
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import torch
import workers
from made import made
from torch import Tensor

from lab.record import result_text

HERE = Path(__file__).parent
SLOW_MS = 3000.0
COMPILED = "torch.compile"
THREADS = (1, 2)


def arguments_as(case, dtype: torch.dtype) -> tuple:
    """Fresh leaves of the case's tensors, floating ones in the dtype."""
    return tuple(
        a.detach().to(dtype, copy=True).requires_grad_(a.requires_grad)
        if isinstance(a, Tensor) and a.is_floating_point()
        else a
        for a in case.arguments
    )


def forward_backward(function, arguments: tuple):
    """A closure of one pass: (values, gradients of a fixed projection of them)."""
    leaves = [a for a in arguments if isinstance(a, Tensor) and a.requires_grad]
    seeds: list[Tensor] = []

    def run() -> tuple[list[Tensor], list[Tensor]]:
        outputs = function(*arguments)
        outputs = [outputs] if isinstance(outputs, Tensor) else list(outputs)
        if not leaves:
            return outputs, []
        through = [o for o in outputs if o.requires_grad]
        if not seeds:
            seeds.extend(torch.linspace(0.5, 1.5, o.numel()).to(o).view(o.shape) for o in through)
        return outputs, list(torch.autograd.grad(through, leaves, seeds))

    return run


def verify(case) -> float:
    """Largest relative L2 error of values and gradients against the reference in float64."""
    worst = case.error() if case.reference is None else _against_reference(case)
    if not worst < case.tolerance:
        raise SystemExit(f"{case.op}, {case.size}: error {worst:.1e} is above {case.tolerance}")
    return worst


def _against_reference(case) -> float:
    ours = forward_backward(case.ours, arguments_as(case, torch.float32))()
    wanted = forward_backward(case.reference, arguments_as(case, torch.float64))()
    worst = 0.0
    for got, want in zip([*ours[0], *ours[1]], [*wanted[0], *wanted[1]], strict=True):
        got = got.to_dense() if got.is_sparse else got
        error = (got.detach().double() - want.detach()).norm() / want.detach().norm()
        worst = max(worst, float(error))
    return worst


def build(index: int, name: str):
    """In a worker: the closure of one contender of cases.CASES[index]."""
    import cases

    logging.getLogger("torch._dynamo").setLevel(logging.ERROR)  # graph breaks of the references
    case = cases.CASES[index][1]()
    if name == COMPILED:
        return forward_backward(torch.compile(case.reference), arguments_as(case, torch.float32))
    return case.peers[name]()


def contenders(case, index: int, peers: bool) -> dict[str, Callable[[], float]]:
    """By name, what runs once and tells the milliseconds; one that cannot run is left out."""
    found: dict[str, Callable[[], float]] = {}
    for name, function in (("univoxel", case.ours), ("torch eager", case.reference)):
        if function is None:
            continue
        run = forward_backward(function, arguments_as(case, torch.float32))
        run()
        run()
        found[name] = functools.partial(workers.milliseconds, run)
    compiled = [] if case.reference is None else [COMPILED]
    for name in [*compiled, *case.peers] if peers else []:
        try:
            found[name] = workers.Worker(build, index, name)
        except RuntimeError as error:
            print(f"{case.op}: {name} left out: {error}", file=sys.stderr)
    return found


def times(found: dict[str, Callable[[], float]], rounds: int) -> dict[str, list[float]]:
    """Milliseconds of every round, contenders in turn; a slow one ends early, with 3 or more."""
    measured: dict[str, list[float]] = {name: [] for name in found}
    for _ in range(rounds):
        for name, run in found.items():
            if name not in measured or (len(measured[name]) >= 3 and sum(measured[name]) > SLOW_MS):
                continue
            try:
                measured[name].append(run())
            except RuntimeError as error:
                print(f"{name} left out: {error}", file=sys.stderr)
                del measured[name]
    for run in found.values():
        if isinstance(run, workers.Worker):
            run.close()
    return measured


def quartiles(values: list[float]) -> dict[str, float]:
    low, median, high = torch.tensor(values).quantile(torch.tensor([0.25, 0.5, 0.75])).tolist()
    return {"median_ms": round(median, 3), "low_ms": round(low, 3), "high_ms": round(high, 3)}


def run_cases(threads: int, only: str, rounds: int) -> dict:
    import cases
    import limits
    import peers

    torch.set_num_threads(threads)
    reach = limits.measure()
    results = []
    for index, (name, make) in enumerate(cases.CASES):
        if only not in name:
            continue
        case = make()
        error = verify(case)
        least, bound = limits.floor(case.work, reach)
        found = contenders(case, index, peers=threads == THREADS[-1])
        measured = {n: quartiles(t) for n, t in times(found, rounds).items()}
        ours = measured["univoxel"]["median_ms"]
        results.append(
            {
                "op": case.op,
                "size": case.size,
                "threads": threads,
                "error": error,
                "floor_ms": round(1e3 * least, 3),
                "bound": bound,
                "fraction_of_bound": round(1e3 * least / ours, 3),
                "contenders": measured,
            }
        )
        print(f"{case.op:14s} {case.size}, threads {threads}, floor {1e3 * least:.1f} ms ({bound})")
        for name, t in measured.items():
            print(
                f"    {name:34s} {t['median_ms']:9.2f} ms  [{t['low_ms']:.2f}, {t['high_ms']:.2f}]"
                f"  {t['median_ms'] / ours:6.1f} x"
            )
    return {"limits": {str(threads): reach}, "results": results, "peers": peers.versions()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="ops whose name contains this (default: all)")
    parser.add_argument("--rounds", type=int, default=11, help="at least 3 (default: 11)")
    parser.add_argument("--out", type=Path, default=HERE / "results" / "ops.json")
    parser.add_argument("--threads", type=int, help=argparse.SUPPRESS)  # in the child processes
    options = parser.parse_args()
    if options.threads:
        result = run_cases(options.threads, options.only, options.rounds)
        options.out.write_text(json.dumps(result))
        return

    merged: dict = {"limits": {}, "results": []}
    for threads in THREADS:
        part = options.out.with_suffix(f".{threads}.part")
        part.parent.mkdir(parents=True, exist_ok=True)
        # XLA sizes its thread pool by the cores it may use.
        cores = sorted(os.sched_getaffinity(0))[:threads]
        subprocess.run(
            [
                *(sys.executable, __file__, "--threads", str(threads), "--only", options.only),
                *("--rounds", str(options.rounds), "--out", str(part)),
            ],
            check=True,
            env={**os.environ, "OMP_WAIT_POLICY": "passive", "OMP_NUM_THREADS": str(threads)},
            preexec_fn=lambda cores=cores: os.sched_setaffinity(0, cores),
        )
        result = json.loads(part.read_text())
        part.unlink()
        merged["limits"] |= result["limits"]
        merged["results"] += result["results"]
        merged["peers"] = result["peers"]
    merged["versions"] = {"python": platform.python_version(), "torch": torch.__version__}
    merged["versions"] |= merged.pop("peers")
    merged["cpu"] = torch.backends.cpu.get_cpu_capability()
    merged["load_average"] = os.getloadavg()[0]  # 1 minute; above the cores: others ran too
    merged["cores"] = len(os.sched_getaffinity(0))
    options.out.write_text(result_text(made() | merged))
    print(options.out)


if __name__ == "__main__":
    main()
