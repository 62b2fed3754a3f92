"""Every model of light on the same scenes: a table, and a picture of it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

from lab import plots, runner
from lab.plots import Measure
from lab.record import Outcome, Setting, result_text
from univoxel.core.choices import LIGHTS, LightName
from univoxel.core.files import write_text
from univoxel.errors import ProcessFailed, UserError

COLUMNS = (
    plots.NVS,
    plots.ALBEDO,
    plots.ALBEDO_1CH,
    plots.ROUGHNESS,
    plots.RELIT,
    plots.NORMAL,
    plots.MAP,
    plots.SECONDS,
    plots.STEPS,
    plots.MEMORY,
    plots.PARAMETERS,
)
MEAN = "mean"  # title of the table over all scenes


def compare(
    scenes: Sequence[Path],
    out: Path,
    preset: str = "auto",
    light: Sequence[str] = LIGHTS,
    minutes: float | None = None,
    changes: Sequence[str] = (),
    samples: int = 64,
    jobs: int = 1,
    scheduler: str | None = None,
) -> Path:
    """Train every scene with every lighting model; write out/compare.md, .json, .png and .svg.

    Args:
        scenes: folders of data sets with different names.
        out: folder that keeps every training run in SCENE/LIGHT; later calls reuse them.
        light: names, as for --light; `NAME:FIELD=VALUE[,FIELD=VALUE]` changes fields of the light.
        preset, minutes: amount of work; see presets.chosen.
        changes: FIELD=VALUE of the configuration, for all training runs.
        samples: light samples per pixel of relit images.
        jobs, scheduler: number of runs at a time, or a Dask scheduler; see runner.run_pairs.

    Returns:
        out/compare.md.

    Raises:
        UserError: a scene or an argument cannot be used; nothing was trained.
        MissingExtra: matplotlib or Dask is missing.
        ProcessFailed: some training runs failed; the files contain the results of the others.
        OSError: a file cannot be written.
    """
    plots.require()
    settings = [_setting(text, preset, minutes, tuple(changes)) for text in light]
    outcomes = runner.run(scenes, settings, out, samples, at_once=jobs, scheduler=scheduler)
    record = {
        "preset": preset,
        "minutes": minutes,
        "changes": list(changes),
        "samples": samples,
        "machine": plots.machine(),
        "rows": [outcome.summary() for outcome in outcomes],
    }
    write_text(out / "compare.json", result_text(record))
    write_text(out / "compare.md", markdown(outcomes))
    if any(not outcome.error for outcome in outcomes):
        plot(outcomes, out / "compare")
    if failed := runner.failures(outcomes):
        raise ProcessFailed(failed)
    return out / "compare.md"


def markdown(outcomes: Sequence[Outcome]) -> str:
    """A table per scene, and one of means where there are several scenes; best values are bold."""
    scenes = list(dict.fromkeys(o.scene for o in outcomes))
    tables = {s: {o.setting: o for o in outcomes if o.scene == s} for s in scenes}
    parts = [_table(scene, rows) for scene, rows in tables.items()]
    if len(scenes) > 1:
        names = list(dict.fromkeys(o.setting for o in outcomes))
        parts.append(_table(MEAN, {n: _mean([tables[s][n] for s in scenes], n) for n in names}))
    return "\n".join(parts)


def plot(outcomes: Sequence[Outcome], stem: Path) -> list[Path]:
    """A panel for each measure that there is, a row for each light, a dot for each scene."""
    from matplotlib.figure import Figure

    lights = list(dict.fromkeys(o.setting for o in outcomes))
    scenes = list(dict.fromkeys(o.scene for o in outcomes))
    shown = [c for c in COLUMNS if any(_value(o, c) is not None for o in outcomes)]
    across = min(4, len(shown))
    down = -(-len(shown) // across)
    height = 0.9 + 0.2 * len(lights) * max(1.5, len(scenes))
    figure = Figure(figsize=(3.4 * across, height * down), layout="constrained")
    axes = figure.subplots(down, across, squeeze=False, sharey=True)
    apart = 0.6 / len(scenes)
    for axis, column in zip(axes.flat, shown, strict=False):
        for k, scene in enumerate(scenes):
            dots = [
                (value, lights.index(o.setting) + (k - (len(scenes) - 1) / 2) * apart)
                for o in outcomes
                if o.scene == scene and (value := _value(o, column)) is not None
            ]
            axis.plot(
                [v for v, _ in dots], [y for _, y in dots], "o", label=scene, color=plots.color(k)
            )
            for value, place in dots:
                text = f"{value:{column.digits}}"
                axis.annotate(
                    text, (value, place), (6, 0), textcoords="offset points", va="center", size=7
                )
        axis.margins(x=0.2)
        axis.locator_params(axis="x", nbins=4)  # long numbers would run into each other
        axis.grid(axis="y", alpha=0.3)
        axis.set_title(f"{column.title} ({'more' if column.more else 'less'} is better)", size=9)
        axis.spines[["top", "right"]].set_visible(False)
    for axis in axes.flat[len(shown) :]:
        axis.set_axis_off()
    axes[0, 0].set_yticks(range(len(lights)), lights)
    axes[0, 0].invert_yaxis()
    if len(scenes) > 1:
        figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center")
    return plots.save_figure(figure, stem)


def _setting(text: str, preset: str, minutes: float | None, changes: tuple[str, ...]) -> Setting:
    name, _, fields = text.partition(":")
    if name not in LIGHTS:
        raise UserError(f"light must be one of {', '.join(LIGHTS)}, got {text!r}", "light")
    light: LightName = name
    own = tuple(f"scene.light.{field}" for field in fields.split(",") if field)
    label = "-".join([name, *fields.split(",")]) if fields else name
    return Setting(label, preset, light, minutes, (*changes, *own))


def _value(outcome: Outcome, column: Measure) -> float | None:
    return outcome.measures.get(column.key)


def _mean(outcomes: Sequence[Outcome], setting: str) -> Outcome:
    """Means of the measures that every scene has."""
    first = outcomes[0].measures
    keys = [k for k in first if all(o.measures.get(k) is not None for o in outcomes)]
    means = {key: fmean(o.measures[key] or 0 for o in outcomes) for key in keys}
    failed = next((o.error for o in outcomes if o.error), None)
    return Outcome(MEAN, setting, {}, means, error=failed)


def _table(title: str, rows: dict[str, Outcome]) -> str:
    lines = [
        f"## {title}\n",
        f"| light | {' | '.join(c.title for c in COLUMNS)} |",
        "|---|" + "---:|" * len(COLUMNS),
    ]
    best = {}
    for column in COLUMNS:
        values = [v for o in rows.values() if (v := _value(o, column)) is not None]
        if values:
            best[column] = max(values) if column.more else min(values)
    for name, outcome in rows.items():
        if outcome.error:
            lines.append(f"| {name} | failed: {outcome.error.replace('|', '/')} |")
            continue
        cells = []
        for column in COLUMNS:
            value = _value(outcome, column)
            text = "-" if value is None else f"{value:{column.digits}}"
            cells.append(f"**{text}**" if value is not None and value == best[column] else text)
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"
