"""What the trainings of a stress suite say: breaking points, tables, the picture."""

from __future__ import annotations

import math
import pydoc
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean, stdev
from typing import Any

from lab import plots
from lab.plots import Measure
from lab.record import Outcome
from lab.stress.axes import Axis, Level
from univoxel.errors import UserError

DROP = 3.0  # dB of relit PSNR below the reference: broken
ACROSS = 4  # panels in a row
# As cli.MISTAKES: what ends in one line
REFUSALS = (UserError, OSError, MemoryError)
COLUMNS = (
    plots.RELIT,
    plots.NVS,
    plots.ALBEDO,
    plots.ALBEDO_1CH,
    plots.ROUGHNESS,
    plots.NORMAL,
    Measure("chamfer", "Chamfer distance", False, ".4f"),
    plots.MAP,
)


@dataclass(frozen=True)
class Cell:
    """One level under one light: the outcomes of its seeds."""

    axis: Axis
    level: Level
    light: str
    outcomes: tuple[Outcome, ...]

    def values(self, key: str) -> list[float]:
        """Finite values of a measure."""
        found = [o.measures.get(key) for o in self.outcomes if not o.error]
        return [v for v in found if v is not None and math.isfinite(v)]

    def mean(self, key: str) -> float | None:
        """None if a seed failed or gave no finite number: half an answer would flatter."""
        found = self.values(key)
        return fmean(found) if found and len(found) == len(self.outcomes) else None

    def spread(self, key: str) -> float:
        """Standard deviation over the seeds; 0 of one."""
        found = self.values(key)
        return stdev(found) if len(found) > 1 else 0.0

    def fault(self) -> str:
        """What went wrong with some seed, the worst of it; empty if nothing did."""
        kinds = {kind(o) for o in self.outcomes}
        return next((k for k in ("crashed", "not finite", "refused") if k in kinds), "")


@dataclass(frozen=True)
class Break:
    """Where a measure fell too far: between two levels, `share` of the way."""

    before: Level
    after: Level
    share: float

    @property
    def value(self) -> float:
        """On the axis: geometric between values above 0, else linear."""
        a, b = self.before.value, self.after.value
        return a * (b / a) ** self.share if a > 0 and b > 0 else a + (b - a) * self.share

    def __str__(self) -> str:
        return f"{self.value:.2g}"


def kind(outcome: Outcome) -> str:
    """ "" | "refused" with a clear message | "not finite" | "crashed" with a traceback."""
    if not outcome.error:
        bad = [v for v in outcome.measures.values() if v is not None and not math.isfinite(v)]
        return "not finite" if bad else ""
    # The last line of a traceback begins with the exception's name, ours with their module
    name = outcome.error.partition(":")[0]
    found = pydoc.locate(name) if name.replace(".", "").replace("_", "").isalnum() else None
    if not isinstance(found, type):
        return "crashed"
    if issubclass(found, FloatingPointError):
        return "not finite"
    return "refused" if issubclass(found, REFUSALS) else "crashed"


def counts(cells: Sequence[Cell]) -> dict[str, int]:
    """How many different trainings there were, and how many of them ended in which way."""
    outcomes = {(o.scene, o.setting): o for c in cells for o in c.outcomes}.values()
    kinds = [kind(o) for o in outcomes]
    return {"trainings": len(kinds)} | {
        k: kinds.count(k) for k in ("refused", "not finite", "crashed")
    }


def breaking_point(
    levels: Sequence[Level], values: Sequence[float | None], reference: int, drop: float = DROP
) -> Break | None:
    """Where values first fall by `drop` below that of the reference, going to harder levels.

    Linear between levels. A level without a value is broken altogether. None if nothing breaks, or
    if the reference has no value.
    """
    top = values[reference]
    if top is None:
        return None
    last = top
    for i in range(reference + 1, len(levels)):
        value = values[i]
        if value is None:
            return Break(levels[i - 1], levels[i], 1.0)
        if value <= top - drop:
            return Break(levels[i - 1], levels[i], (last - (top - drop)) / (last - value))
        last = value
    return None


def breaks(cells: Sequence[Cell]) -> dict[tuple[str, str], Break | None]:
    """The breaking point of relit PSNR by axis and light."""
    found = {}
    for axis, light in dict.fromkeys((c.axis, c.light) for c in cells):
        row = _row(cells, axis, light)
        values = [c.mean(plots.RELIT.key) for c in row]
        found[axis.name, light] = breaking_point(axis.levels, values, axis.reference)
    return found


def markdown(cells: Sequence[Cell]) -> str:
    """Breaking points, then a table of the measures for each axis."""
    axes, lights = _axes(cells), _lights(cells)
    made, said, found = plots.machine(), counts(cells), breaks(cells)
    lines = [
        "# Breaking points\n",
        f"{said['trainings']} trainings on {made['threads']} threads of {made['processor']}: "
        f"{said['refused']} refused, {said['not finite']} not finite, {said['crashed']} crashed.\n",
        f"Breaking point: the level at which the relit PSNR is {DROP:g} dB below the reference.\n",
        f"| axis | severities | {' | '.join(lights)} |",
        "|---|---|" + "---|" * len(lights),
    ]
    for axis in axes:
        labels = [_mark(axis, level) for level in axis.levels]
        cell = [_text(cells, axis, light, found) for light in lights]
        lines.append(f"| {axis.name}: {axis.title} | {', '.join(labels)} | {' | '.join(cell)} |")
    for axis in axes:
        lines += [
            f"\n## {axis.name}\n",
            f"| {axis.title} | light | {' | '.join(c.title for c in COLUMNS)} |",
            "|---|---|" + "---:|" * len(COLUMNS),
        ]
        for level in axis.levels:
            for light in lights:
                cell = next(c for c in _row(cells, axis, light) if c.level == level)
                lines.append(f"| {_mark(axis, level)} | {light} | {_values(cell)} |")
    return "\n".join(lines) + "\n"


def plot(cells: Sequence[Cell]) -> Any:
    """A figure with a panel for each axis and a line for each light: relit PSNR."""
    from matplotlib.figure import Figure

    axes, lights, found = _axes(cells), _lights(cells), breaks(cells)
    across = min(ACROSS, len(axes))
    down = -(-len(axes) // across)
    figure = Figure(figsize=(3.4 * across, 2.6 * down + 0.6), layout="constrained")
    panels = figure.subplots(down, across, squeeze=False, sharey=True)
    known = [v for c in cells if (v := c.mean(plots.RELIT.key)) is not None]
    floor = min(known, default=0.0) - 2
    for panel, axis in zip(panels.flat, axes, strict=False):
        for k, light in enumerate(lights):
            row = _row(cells, axis, light)
            _draw_line(panel, row, found[axis.name, light], floor, plots.color(k), light)
        panel.set_xticks(range(len(axis.levels)), [level.label for level in axis.levels])
        panel.set_title(axis.name, size=10)
        panel.set_xlabel(axis.title, size=8)
        panel.margins(x=0.12)
        panel.grid(alpha=0.25)
        panel.spines[["top", "right"]].set_visible(False)
    for panel in panels.flat[len(axes) :]:
        panel.set_axis_off()
    for row in panels:
        row[0].set_ylabel("relit, dB")
    if len(lights) > 1:
        handles = panels[0, 0].get_legend_handles_labels()
        figure.legend(*handles, loc="outside lower center", ncols=len(lights))
    figure.suptitle(
        f"Relit PSNR, harder to the right; dotted: {DROP:g} dB below the reference (ringed); "
        "cross: no result",
        size=9,
    )
    return figure


def _draw_line(
    panel: Any, row: Sequence[Cell], broken: Break | None, floor: float, color: str, label: str
) -> None:
    key = plots.RELIT.key
    axis = row[0].axis
    means = [(i, m, c.spread(key)) for i, c in enumerate(row) if (m := c.mean(key)) is not None]
    x, y, error = zip(*means, strict=True) if means else ((), (), ())
    panel.errorbar(x, y, error, fmt="o-", color=color, markersize=4, capsize=2, label=label)
    for i, cell in enumerate(row):
        if fault := cell.fault():
            panel.plot(i, floor, "x", color=color)
            panel.annotate(
                fault, (i, floor), (0, 5), textcoords="offset points", size=7, ha="center"
            )
    top = row[axis.reference].mean(key)
    if top is not None:
        panel.plot(axis.reference, top, "o", color=color, fillstyle="none", markersize=9)
    if broken is not None and top is not None:
        place = axis.levels.index(broken.before) + broken.share
        panel.plot([axis.reference, place], [top - DROP] * 2, ":", color=color, linewidth=1)
        panel.plot(place, top - DROP, "|", color=color, markersize=10)


def _row(cells: Sequence[Cell], axis: Axis, light: str) -> list[Cell]:
    """The cells of an axis under a light, in the order of its levels."""
    return [c for c in cells if c.axis.name == axis.name and c.light == light]


def _axes(cells: Sequence[Cell]) -> list[Axis]:
    return list({c.axis.name: c.axis for c in cells}.values())


def _lights(cells: Sequence[Cell]) -> list[str]:
    return list(dict.fromkeys(c.light for c in cells))


def _mark(axis: Axis, level: Level) -> str:
    """The reference is bold."""
    return f"**{level.label}**" if level == axis.levels[axis.reference] else level.label


def _text(
    cells: Sequence[Cell], axis: Axis, light: str, found: dict[tuple[str, str], Break | None]
) -> str:
    row, key = _row(cells, axis, light), plots.RELIT.key
    broken, top = found[axis.name, light], row[axis.reference].mean(key)
    if top is None:
        return "reference failed"
    if broken is not None:
        return str(broken)
    harder = [v for c in row[axis.reference + 1 :] if (v := c.mean(key)) is not None]
    lost = min(harder, default=top) - top
    return f"holds ({lost:+.1f} dB)"


def _values(cell: Cell) -> str:
    texts = []
    for column in COLUMNS:
        mean = cell.mean(column.key)
        spread = f" ± {cell.spread(column.key):{column.digits}}" if len(cell.outcomes) > 1 else ""
        texts.append("-" if mean is None else f"{mean:{column.digits}}{spread}")
    if fault := cell.fault():
        reason = next((o.error for o in cell.outcomes if o.error), None) or "a measure"
        texts[0] = f"{fault}: {reason.replace('|', '/')}"
    return " | ".join(texts)
