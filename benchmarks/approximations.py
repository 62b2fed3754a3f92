"""Error against time where the package approximates: directions of the quadrature under spherical
Gaussians, float32 against float64.

    python benchmarks/approximations.py [--out benchmarks/results/approximations.json]

Points, lobes and materials are random, lobes as sharp as training allows; the truth is float64 with
4096 directions. Both passes are timed and both are judged: values and gradients.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import time
from pathlib import Path

import torch
from made import made
from torch import Tensor

from lab.record import result_text
from univoxel import sphere
from univoxel.ops import shade_sg

HERE = Path(__file__).parent
DIRECTIONS = (32, 64, 128, 256, 512)
TRUTH = 4096
POINTS, LOBES = 2048, 16
NAMES = ("axis", "sharpness", "amplitude", "normal", "wo", "albedo", "roughness")


def points() -> tuple[list[Tensor], Tensor]:
    """Arguments of shade_sg in float64, and the turns."""
    g = torch.Generator().manual_seed(0)

    def unit(*size):
        x = torch.randn(*size, 3, generator=g, dtype=torch.float64)
        return torch.nn.functional.normalize(x, dim=-1)

    def uniform(low, high, *size):
        return low + (high - low) * torch.rand(*size, generator=g, dtype=torch.float64)

    normal = unit(POINTS)
    tensors = [
        unit(POINTS, LOBES),
        uniform(0.1, 30, POINTS, LOBES),
        uniform(0, 1, POINTS, LOBES, 3),
        normal,
        torch.nn.functional.normalize(normal + 0.7 * unit(POINTS), dim=-1),
        uniform(0, 1, POINTS, 3),
        uniform(0.2, 1, POINTS),
    ]
    return tensors, uniform(0, 2 * math.pi, POINTS)


def run(tensors: list[Tensor], turns: Tensor, count: int, dtype: torch.dtype):
    """A closure of both passes: rgb and the gradients of its sum."""
    leaves = [t.to(dtype).requires_grad_() for t in tensors]
    directions, turns = sphere.fibonacci_hemisphere(count, dtype), turns.to(dtype)

    def both() -> list[Tensor]:
        rgb = shade_sg(*leaves, directions, turns)
        return [rgb.detach(), *torch.autograd.grad(rgb.sum(), leaves)]

    return both


def error(got: Tensor, want: Tensor) -> float:
    return float((got.double() - want).norm() / want.norm())


def measure(rounds: int) -> list[dict]:
    tensors, turns = points()
    truth = run(tensors, turns, TRUTH, torch.float64)()
    rows = []
    for count in DIRECTIONS:
        exact = run(tensors, turns, count, torch.float64)()
        for dtype in (torch.float32, torch.float64):
            both = run(tensors, turns, count, dtype)
            got = both()
            seconds = []
            for _ in range(rounds):
                start = time.perf_counter()
                both()
                seconds.append(time.perf_counter() - start)
            rows.append(
                {
                    "directions": count,
                    "dtype": str(dtype).removeprefix("torch."),
                    "ms": 1e3 * statistics.median(seconds),
                    "error": error(got[0], truth[0]),
                    "grad_error": {
                        n: error(a, b) for n, a, b in zip(NAMES, got[1:], truth[1:], strict=True)
                    },
                    "rounding": max(error(a, b) for a, b in zip(got, exact, strict=True)),
                }
            )
            print({k: v for k, v in rows[-1].items() if k != "grad_error"}, flush=True)
    return rows


def draw(path: Path) -> None:
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    rows = json.loads(path.read_text())["shade_sg"]
    figure, axis = plt.subplots(figsize=(7, 5))
    for dtype, mark in (("float32", "o-"), ("float64", "s--")):
        own = [r for r in rows if r["dtype"] == dtype]
        ms = [r["ms"] for r in own]
        axis.loglog(ms, [r["error"] for r in own], mark, color="black", label=f"radiance, {dtype}")
        if dtype == "float64":
            continue
        for name in NAMES:
            errors = [r["grad_error"][name] for r in own]
            axis.loglog(ms, errors, ".-", alpha=0.6, label=f"gradient to {name}")
        axis.loglog(ms, [r["rounding"] for r in own], "k:", label="rounding alone, worst")
        for r in own:
            axis.annotate(str(r["directions"]), (r["ms"], r["error"]), fontsize=8)
    axis.set_xlabel(f"ms, forward + backward, {POINTS} points x {LOBES} lobes")
    axis.set_ylabel(f"relative L2 error; truth: {TRUTH} directions in float64")
    axis.legend(fontsize=7)
    figure.tight_layout()
    for suffix in (".png", ".svg"):
        figure.savefig(path.with_suffix(suffix), dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--out", type=Path, default=HERE / "results" / "approximations.json")
    options = parser.parse_args()
    result = {
        "points": POINTS,
        "lobes": LOBES,
        "truth_directions": TRUTH,
        "threads": torch.get_num_threads(),
        "shade_sg": measure(options.rounds),
        "load_average": os.getloadavg()[0],
    }
    options.out.write_text(result_text(made() | result))
    draw(options.out)


if __name__ == "__main__":
    main()
