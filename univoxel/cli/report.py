"""Report on a trained run: its quality, its expected errors, and what to photograph next."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from univoxel.cli.parsing import DataOf, File, Run, Title, takes, written

REPORT = "report.html"  # in the folder of a run, unless another file is named


@dataclass(frozen=True)
class ReportOptions:
    run: Run
    """folder of a trained run"""
    html: Annotated[Path | None, written("FILE.html", "RUN/report.html")] = None
    """web page to write, which works offline"""
    data: DataOf = None
    """folder of the photographs, if they were moved"""
    views: Annotated[int, written("N")] = 4
    """number of photographs to show beside their render, the worst first"""
    title: Title = None
    """heading of the page"""


@takes(ReportOptions)
def command(asked: ReportOptions) -> Path:
    """Report how good a run is and what to photograph next.

    The web page shows photographs beside their render, expected errors, materials,
    light, the progress of training, and directions from which more photographs would help. The
    report needs no ground truth.
    """
    return report(**vars(asked))


def report(run: File, html: File | None = None, **options: Any) -> Path:
    """Write the report of a run; arguments and errors are those of
    `univoxel.output.report.write_report`.

    Args:
        html: the page; in the run's folder when left out.
    """
    from univoxel.detail.texture import albedo_near
    from univoxel.output.report import write_report

    options |= {"albedo_near": albedo_near(run)}
    return write_report(run, Path(run) / REPORT if html is None else html, **options)
