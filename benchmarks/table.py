"""Print the results of benchmarks/ops.py as the Markdown table of docs/speed.md.

python benchmarks/table.py [RESULTS.json]
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

HERE = Path(__file__).parent
EAGER = "torch eager"


def rows(data: dict) -> list[str]:
    """One line a case: milliseconds, ratios in the same run, scaling, share of the floor."""
    most = max(r["threads"] for r in data["results"])
    alone = {(r["op"], r["size"]): r for r in data["results"] if r["threads"] == 1}
    lines = [
        f"| op | size | ms, {most} threads | over eager torch | nearest other | "
        f"1 to {most} threads | floor, ms |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in data["results"]:
        if r["threads"] != most:
            continue
        times = {name: t["median_ms"] for name, t in r["contenders"].items()}
        ours = times.pop("univoxel")
        eager = times.pop(EAGER, None)
        nearest = min(times, key=lambda name: times[name], default=None)
        before = alone[r["op"], r["size"]]["contenders"]["univoxel"]["median_ms"]
        cells = [
            f"`{r['op']}`",
            r["size"],
            f"{ours:.1f}",
            f"{eager / ours:.1f} x" if eager else "",
            f"{times[nearest] / ours:.1f} x ({nearest})" if nearest else "",
            f"{before / ours:.2f} x",
            f"{r['floor_ms']:.1f} ({r['bound']})" if r["bound"] else "",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


if __name__ == "__main__":
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "results" / "ops.json"
    print("\n".join(rows(json.loads(path.read_text()))))
