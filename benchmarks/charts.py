"""Draw the results of benchmarks/ops.py, from the file alone: PNG and SVG beside it.

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


def draw(path: Path) -> None:
    """One panel per case: a bar per contender, whiskers at the quartiles, the floor as a line."""
    data = json.loads(path.read_text())
    results = data["results"]
    if not results:
        raise SystemExit(f"{path}: no results")
    threads = sorted({r["threads"] for r in results})
    rows = -(-len(results) // len(threads))
    figure, axes = plt.subplots(
        rows, len(threads), figsize=(6 * len(threads), 2.0 * rows + 0.8), squeeze=False
    )
    for column, count in enumerate(threads):
        chosen = [r for r in results if r["threads"] == count]
        for axis, result in zip(axes[:, column], chosen, strict=False):
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
            axis.invert_yaxis()
            axis.set_title(
                f"{result['op']}: {result['size']}, {count} thread{'s' * (count > 1)}", fontsize=9
            )
            axis.spines[["top", "right"]].set_visible(False)
    axes[-1, 0].set_xlabel("ms, forward + backward; dotted: this machine's floor")
    versions = ", ".join(f"{k} {v}" for k, v in data["versions"].items())
    figure.suptitle(f"{data['commit']} on {data['cores']} cores, {data['cpu']}; {versions}", size=8)
    figure.tight_layout()
    for suffix in (".png", ".svg"):
        figure.savefig(path.with_suffix(suffix), dpi=130)
        print(path.with_suffix(suffix))
    plt.close(figure)


if __name__ == "__main__":
    for file in sys.argv[1:] or [HERE / "results" / "ops.json"]:
        draw(Path(file))
