"""What this machine can do at best, measured: the floor under every op's time."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch


def measure() -> dict[str, float]:
    """Rates per second on torch's number of threads.

    read: bytes streamed from memory; gather: random rows of 64 bytes out of 1 GB; fma: fused
    multiply-adds in float32, as two operations each; exp: exponentials in float32.
    """
    table = torch.ones(2**24, 16)
    rows = torch.randint(len(table), (2**20,))
    bags = torch.arange(0, len(rows), 64)
    a = torch.randn(1024, 1024)
    x = torch.randn(2**18)
    out = torch.empty_like(x)
    return {
        "read": table.numel() * 4 / _best(lambda: table.sum(), 5),
        "gather": len(rows)
        / _best(lambda: torch.nn.functional.embedding_bag(rows, table, bags, mode="sum"), 5),
        "fma": 2 * 1024**3 / _best(lambda: a @ a, 10),
        "exp": len(x) / _best(lambda: torch.exp(x, out=out), 50),
    }


def floor(work: dict[str, float], limits: dict[str, float]) -> tuple[float, str]:
    """Least seconds that work (amounts by the names of `measure`) can take, and what bounds it.

    No work stands for an amount that nobody can name: 0 seconds, unbounded.
    """
    return max(((amount / limits[name], name) for name, amount in work.items()), default=(0.0, ""))


def _best(run: Callable[[], object], repeats: int) -> float:
    run()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return min(times)
