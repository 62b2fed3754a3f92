"""A trained run as a report: how good it is, where it is in doubt, what to photograph next."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from univoxel.report import write_report

REPORT = "report.html"  # in the folder of a run, unless another file is named


def report(run: str | Path, html: str | Path | None = None, **options: Any) -> Path:
    """Write the report of a run; arguments and errors as of `univoxel.report.write_report`.

    Args:
        html: the page; in the run's folder when left out.
    """
    return write_report(run, Path(run) / REPORT if html is None else html, **options)
