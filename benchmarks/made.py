"""When, and of which version, a result is: the first keys of every file in results/."""

from __future__ import annotations

import subprocess
from datetime import date
from pathlib import Path

# What decides a result. The commit is the last that changed any of it: pages and results may be
# committed between two measurements of one version.
MEASURED = [":/univoxel", ":/lab", ":/csrc", ":/cmake", ":/CMakeLists.txt", ":!/lab/tests"]
# A commit with this line changes no result, and does not count: CONTRIBUTING.md.
COUNTED = ["--invert-grep", "--grep=^Figures: unchanged$"]


def made() -> dict[str, str]:
    """Today's date and the commit of package and kernels, with -dirty where they differ from it."""
    commit = _git("log", "-1", "--format=%h", *COUNTED, "--", *MEASURED) or "unknown"
    changed = _git("status", "--porcelain", "--", *MEASURED)
    return {"date": date.today().isoformat(), "commit": commit + ("-dirty" if changed else "")}


def _git(*arguments: str) -> str:
    told = subprocess.run(
        ["git", *arguments],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        check=False,
    )
    return told.stdout.strip()
