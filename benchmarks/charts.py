"""Draw the results of benchmarks/ops.py, from the file only: PNG and SVG beside it.

python benchmarks/charts.py [RESULTS.json ...]
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt

HERE = Path(__file__).parent
COLORS = {"univoxel": "#1a6faf"}
COLUMNS = 2


def draw(path: Path) -> None:
    """One panel per case, on the most threads: a bar per contender, whiskers at the quartiles, the
    floor as a line."""
    data = json.loads(path.read_text())
    if not data["results"]:
        raise SystemExit(f"{path}: no results")
    threads = max(r["threads"] for r in data["results"])
    results = [r for r in data["results"] if r["threads"] == threads]
    rows = -(-len(results) // COLUMNS)
    figure, axes = plt.subplots(
        rows, COLUMNS, figsize=(6 * COLUMNS, 1.8 * rows + 0.8), squeeze=False
    )
    for axis in axes.flat[len(results) :]:
        axis.set_axis_off()
    for axis, result in zip(axes.flat, results, strict=False):
        bars = result["contenders"]
        median = [b["median_ms"] for b in bars.values()]
        whiskers = [
            [m - b["low_ms"] for m, b in zip(median, bars.values(), strict=True)],
            [b["high_ms"] - m for m, b in zip(median, bars.values(), strict=True)],
        ]
        colors = [COLORS.get(name, "#b0b0b0") for name in bars]
        shown = axis.barh(list(bars), median, xerr=whiskers, color=colors, ecolor="#404040")
        axis.bar_label(shown, [f" {m:.1f}" for m in median], padding=4)
        if result["bound"]:
            axis.axvline(result["floor_ms"], color="#c03020", linestyle=":")
        axis.set_xscale("log")
        axis.set_xlim(right=max(median) * 3)
        axis.xaxis.set_minor_formatter("")
        axis.invert_yaxis()
        axis.set_title(f"{result['op']}: {result['size']}", fontsize=9)
        axis.spines[["top", "right"]].set_visible(False)
    axes[-1, 0].set_xlabel("ms, forward + backward; dotted: this machine's floor")
    versions = ", ".join(f"{k} {v}" for k, v in data["versions"].items())
    figure.tight_layout(rect=(0, 0, 1, 0.97))
    figure.suptitle(f"{data['commit']}, {threads} threads, {data['cpu']}; {versions}", size=8)
    for suffix in (".png", ".svg"):
        figure.savefig(path.with_suffix(suffix), dpi=100)
        print(path.with_suffix(suffix))
    plt.close(figure)


if __name__ == "__main__":
    for file in sys.argv[1:] or [HERE / "results" / "ops.json"]:
        draw(Path(file))
