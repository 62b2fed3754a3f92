"""Quality against training time: presets, and single knobs around one of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

from lab import plots, runner
from lab.plots import Measure
from lab.record import Outcome, Setting, result_text
from univoxel.config import StageConfig, TrainConfig
from univoxel.core.choices import LIGHTS, LightName
from univoxel.core.files import write_text
from univoxel.errors import ProcessFailed, UserError

BETWEEN = (3, 6)  # minutes, where the curve is looked at between the presets
PRESETS = ("draft", "fast", "full", "best")
SHOWN = (plots.NVS, plots.ALBEDO, plots.ROUGHNESS, plots.RELIT, plots.NORMAL)
ACROSS = 3  # panels in a row
QUICK = ("voxels-x0.5", "rays-x0.5", "light-sg", "light-baked")  # beside draft and the preset


@dataclass(frozen=True)
class Published:
    """A figure from a paper: another data set, a GPU. The pages show them beside ours."""

    name: str
    where: str  # data and machine
    minutes: float | None  # of training; None if none is published
    measures: dict[str, float]


def _published(name: str, where: str, minutes: float | None, *values: float) -> Published:
    keys = (plots.NVS.key, plots.ALBEDO.key, plots.ROUGHNESS.key, plots.RELIT.key)
    return Published(name, where, minutes, dict(zip(keys, values, strict=True)))


# Wu et al. 2024 (UniVoxel), their comparison of lights, and what others report
_MII = "MII synthetic, RTX 3090"
PUBLISHED = (
    _published("UniVoxel, 16 SG", _MII, 18, 36.232, 29.933, 0.007, 29.445),
    _published("UniVoxel, 128 SG map", _MII, 58, 34.185, 27.368, 0.012, 27.446),
    _published("UniVoxel, 256x512 map", _MII, 120, 35.042, 29.369, 0.010, 29.592),
    _published("best of the field", "Synthetic4Relight, GPU", 14, 37.1, 30.8, 0.004, 35.9),
    Published("UniVoxel", "Shiny Blender, RTX 3090", None, {plots.NORMAL.key: 9.3}),
    Published("best of the field", "Shiny Blender, GPU", None, {plots.NORMAL.key: 2.0}),
)


def chart(
    scenes: Sequence[Path],
    out: Path,
    preset: str = "fast",
    light: LightName = "hybrid",
    quick: bool = False,
    only: Sequence[str] = (),
    changes: Sequence[str] = (),
    samples: int = 64,
    seeds: int = 1,
    jobs: int = 1,
    scheduler: str | None = None,
) -> Path:
    """Train every scene with presets and variants; write out/chart.json, .png and .svg.

    Args:
        scenes: folders of data sets with different names.
        out: folder that keeps every training run in SCENE/SETTING; later calls reuse them.
        preset: preset to vary.
        light: lighting model.
        quick: draft, the preset and three variants.
        only: names of settings; empty: all.
        changes: FIELD=VALUE of the configuration, for all training runs.
        samples: light samples per pixel of relit images.
        seeds: training runs with `preset` on each scene, >= 1; files and figure show their medians.
        jobs, scheduler: number of runs at a time, or a Dask scheduler; see runner.run_pairs.

    Returns:
        out/chart.png.

    Raises:
        UserError: a scene or an argument cannot be used; nothing was trained.
        MissingExtra: matplotlib or Dask is missing.
        ProcessFailed: some training runs failed; the files contain the results of the others.
        OSError: a file cannot be written.
    """
    plots.require()
    chosen = settings(preset, light, tuple(changes))
    wanted = only or ((*dict.fromkeys(("draft", preset)), *QUICK) if quick else tuple(chosen))
    if unknown := [name for name in wanted if name not in chosen]:
        raise UserError(f"only must be among {', '.join(chosen)}, got {', '.join(unknown)}", "only")
    if seeds < 1:
        raise UserError(f"seeds must be at least 1, got {seeds}", "seeds")
    groups = [[seeded(chosen[x], k) for k in range(seeds if x == preset else 1)] for x in wanted]
    trained = [setting for group in groups for setting in group]
    runs = iter(runner.run(scenes, trained, out, samples, at_once=jobs, scheduler=scheduler))
    found = [[next(runs) for _ in group] for _ in scenes for group in groups]
    outcomes = [median_of(group) for group in found]
    record = {
        "preset": preset,
        "light": light,
        "changes": list(changes),
        "samples": samples,
        "machine": plots.machine(),
        "seeds": seeds,
        "points": [
            outcome.summary() | {"ranges": ranges(group)}
            for outcome, group in zip(outcomes, found, strict=True)
        ],
        "fronts": fronts(outcomes),
        "published": [asdict(point) for point in PUBLISHED],
    }
    write_text(out / "chart.json", result_text(record))
    if any(not outcome.error for outcome in outcomes):
        plot(outcomes, out / "chart")
    if failed := runner.failures([run for group in found for run in group]):
        raise ProcessFailed(failed)
    return out / "chart.png"


def seeded(setting: Setting, seed: int) -> Setting:
    """The setting with a random seed; 0 is that of the presets."""
    if not seed:
        return setting
    name, changes = f"{setting.name}-s{seed}", (*setting.changes, f"seed={seed}")
    return replace(setting, name=name, changes=changes)


def median_of(runs: Sequence[Outcome]) -> Outcome:
    """The outcome of a setting: the median of each measure over its seeds. It has the log of the
    first, and is a failure if one of them is, because half of the seeds would flatter."""
    failed = [run.error for run in runs if run.error]
    if failed:
        return replace(runs[0], measures={}, error=failed[0])
    values = _by_measure(runs)
    return replace(runs[0], measures={key: median(found) for key, found in values.items()})


def ranges(runs: Sequence[Outcome]) -> dict[str, float]:
    """By measure, how far the seeds of a setting lie apart."""
    return {key: max(found) - min(found) for key, found in _by_measure(runs).items()}


def _by_measure(runs: Sequence[Outcome]) -> dict[str, list[float]]:
    """The measures that every run has."""
    keys = [key for key in runs[0].measures if all(r.measures.get(key) is not None for r in runs)]
    return {key: [float(run.measures[key] or 0) for run in runs] for key in keys}


def settings(preset: str, light: LightName, changes: tuple[str, ...] = ()) -> dict[str, Setting]:
    """The presets, and the preset with one knob turned, by name.

    Raises:
        ValueError: no such preset or light, or changes that it does not take.
    """
    base = Setting(preset, preset, light, None, changes)
    config = base.config(Path(), Path())
    found = [Setting(name, name, light, None, changes) for name in PRESETS]
    found += [Setting(f"minutes-{m}", "auto", light, m, changes) for m in BETWEEN]
    for name, own in _knobs(config).items():
        found.append(replace(base, name=name, changes=(*changes, *own)))
    found += [replace(base, name=f"light-{x}", light=x) for x in LIGHTS if x != light]
    return {setting.name: setting for setting in found}


def fronts(outcomes: Sequence[Outcome]) -> dict[str, dict[str, list[str]]]:
    """By scene and measure, the settings that no other beats in both time and quality."""
    found: dict[str, dict[str, list[str]]] = {}
    for scene in dict.fromkeys(o.scene for o in outcomes):
        found[scene] = {}
        for measure in SHOWN:
            there = _points(outcomes, scene, measure)
            front = plots.pareto([point for _, point in there], measure.more)
            found[scene][measure.key] = [there[i][0] for i in front]
    return found


def plot(outcomes: Sequence[Outcome], stem: Path) -> list[Path]:
    """For each scene a panel for each measure that there is, and one of the validation pixels while
    training continued."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogFormatter

    scenes = list(dict.fromkeys(o.scene for o in outcomes))
    shown = [m for m in SHOWN if any(_points(outcomes, s, m) for s in scenes)]
    rows = -(-(len(shown) + 1) // ACROSS)  # of a scene
    figure = Figure(figsize=(4.6 * ACROSS, 3.6 * rows * len(scenes)), layout="constrained")
    axes = figure.subplots(rows * len(scenes), ACROSS, squeeze=False).reshape(len(scenes), -1)
    marks = _marks(outcomes)
    for row, scene in zip(axes, scenes, strict=True):
        for axis, measure in zip(row, shown, strict=False):
            _draw_measure(axis, measure, _points(outcomes, scene, measure), marks)
            axis.set_title(f"{scene}: {measure.title}", size=10)
        log, *unused = row[len(shown) :]
        _draw_logs(log, [o for o in outcomes if o.scene == scene and not o.error])
        log.set_title(f"{scene}: validation PSNR of training views, dB", size=10)
        for axis in (*row[: len(shown)], log):
            axis.set_xscale("log")
            axis.xaxis.set_major_formatter(LogFormatter(minor_thresholds=(1.5, 0.5)))
            axis.xaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1.5, 0.5)))
            axis.set_xlabel("training, seconds")
            axis.grid(alpha=0.25)
            axis.spines[["top", "right"]].set_visible(False)
        for axis in unused:
            axis.set_axis_off()
    made = plots.machine()
    legend = ", ".join(f"{mark} {name}" for name, mark in marks.items() if name != mark)
    figure.suptitle(
        f"{made['threads']} threads of {made['processor']}. Line: Pareto front.\n{legend}",
        size=9,
        wrap=True,
    )
    return plots.save_figure(figure, stem)


def _marks(outcomes: Sequence[Outcome]) -> dict[str, str]:
    """What is beside a setting's dots: a preset's name, a number for others."""
    names = list(dict.fromkeys(o.setting for o in outcomes))
    others = [name for name in names if name not in PRESETS]
    return {name: name if name in PRESETS else str(others.index(name) + 1) for name in names}


def _draw_measure(
    axis: Any,
    measure: Measure,
    points: list[tuple[str, tuple[float, float]]],
    marks: dict[str, str],
) -> None:
    place = [point for _, point in points]
    if not measure.more:
        axis.invert_yaxis()  # better is up in every panel
    front = [place[i] for i in plots.pareto(place, measure.more)]
    axis.plot(*_columns(front), color=plots.color(0), linewidth=1, drawstyle="steps-post")
    for name, point in points:
        kind = (
            0
            if name in PRESETS or name.startswith("minutes-")
            else 2
            if name.startswith("light-")
            else 1
        )
        axis.plot(*point, "os^"[kind], color=plots.color(kind), markersize=8 - 3 * (kind > 0))
        axis.annotate(marks[name], point, (4, 3), textcoords="offset points", size=8)


def _draw_logs(axis: Any, outcomes: Iterable[Outcome]):
    for outcome in outcomes:
        front = outcome.setting in PRESETS
        seen = [e for e in outcome.log if e["held_out_psnr"] is not None and e["seconds"] > 0]
        curve = [(entry["seconds"], entry["held_out_psnr"]) for entry in seen]
        color = plots.color(PRESETS.index(outcome.setting)) if front else "grey"
        label = outcome.setting if front else None
        axis.plot(*_columns(curve), color=color, linewidth=1.5 if front else 0.6, label=label)
    if axis.get_legend_handles_labels()[0]:
        axis.legend(fontsize=7)


def _columns(points: Sequence[tuple[float, float]]) -> tuple[list[float], list[float]]:
    return [x for x, _ in points], [y for _, y in points]


def _points(
    outcomes: Sequence[Outcome], scene: str, measure: Measure
) -> list[tuple[str, tuple[float, float]]]:
    """Setting, seconds and value of a scene's trainings that came through."""
    found = []
    for o in outcomes:
        seconds, value = o.measures.get(plots.SECONDS.key), o.measures.get(measure.key)
        if o.scene == scene and seconds is not None and value is not None:
            found.append((o.setting, (seconds, value)))
    return found


def _knobs(config: TrainConfig) -> dict[str, tuple[str, ...]]:
    """FIELD=VALUE that turn one knob of a configuration, by name."""
    stages = list(enumerate(config.stages))
    finest = max(s.voxels for _, s in stages if isinstance(s, StageConfig))
    found: dict[str, tuple[str, ...]] = {}
    if config.capacity == "adaptive":
        found["capacity-fixed"] = ("capacity=fixed",)

    def turn(name: str, wanted: Callable[[Any], bool], field: str, factor: float) -> None:
        own = []
        for i, stage in stages:
            if wanted(stage):
                value = getattr(stage, field) * factor
                own.append(f"stages.{i}.{field}={value if field == 'voxels' else round(value)}")
        found[f"{name}-x{factor:g}"] = tuple(own)

    for factor in (0.5, 2.0):
        turn("voxels", lambda s: getattr(s, "voxels", None) == finest, "voxels", factor)
        turn("rays", lambda s: True, "rays", factor)
        turn("steps", lambda s: True, "iterations", factor)
        for field in ("lobes", "directions"):
            value = getattr(config.scene.light, field, None)
            if value:
                changed = f"scene.light.{field}={round(factor * value)}"
                found[f"{field}-x{factor:g}"] = (changed,)
    return found
