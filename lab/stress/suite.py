"""The stress suite: render, damage, train, measure, draw."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

from lab import plots, runner
from lab.record import Outcome, Setting, result_text
from lab.stress import axes as of_axes
from lab.stress import render, report
from lab.stress.axes import BASE, INTACT, SECOND, Axis, Level
from lab.stress.damage import Damage, clipped, damaged
from lab.stress.report import Cell
from lab.stress.scenes import Spec
from univoxel.core import log
from univoxel.core.choices import LIGHTS, LightName
from univoxel.core.files import write_text
from univoxel.errors import UserError

SHOWN: tuple[LightName, ...] = ("hybrid", "sg", "sh", "envmap")
SEEDS = 3
SAMPLES = 64  # of the light, per pixel of relit pictures
# So many that no machine is too slow for all steps: results shall not depend on the load
MINUTES = 60.0
IDENTITY = "damage.json"
SMALL = (
    "capacity=fixed",
    *("stages.0.voxels=0.1", "stages.0.iterations=120", "stages.0.rays=512"),
    *("stages.1.voxels=0.25", "stages.1.iterations=160", "stages.1.rays=1024"),
)
SMALL_HYBRID = (
    *("stages.2.iterations=100", "stages.2.rays=2048", "stages.2.points=4000"),
    *("stages.2.newton_points=1500", "stages.2.rounds=2"),
    *("stages.3.voxels=0.25", "stages.3.iterations=40", "stages.3.rays=1024"),
)


def stress(
    out: Path,
    only: Sequence[str] = (),
    light: Sequence[str] = (),
    seeds: int | None = None,
    quick: bool = False,
    changes: Sequence[str] = (),
    jobs: int = 1,
    scheduler: str | None = None,
) -> Path:
    """Train on harder and harder scenes; write out/stress.md, .json, .png and .svg.

    Args:
        out: out/scenes keeps what was rendered, out/data the photographs made of it, out/runs every
            training: a later call continues.
        only: names of axes; all when empty.
        light: models of light; when empty SHOWN, or hybrid alone where it shall be quick.
        seeds: of the training and of what is random in the photographs, >= 1; when None 3, or 1.
        quick: fewer severities.
        changes: FIELD=VALUE of the configuration, for all.
        jobs, scheduler: trainings at once here, or who else trains; as in runner.run_pairs.

    Returns:
        out/stress.md. A training that failed is a result.

    Raises:
        UserError: an argument cannot be used, or `out` holds other scenes or settings.
        MissingExtra: Mitsuba, matplotlib or Dask is missing.
        ProcessFailed: Mitsuba failed.
        OSError: a file cannot be written.
    """
    found = of_axes.chosen(only, quick)
    lights = _lights(light) or (("hybrid",) if quick else SHOWN)
    seeds = (1 if quick else SEEDS) if seeds is None else seeds
    if seeds < 1:
        raise UserError(f"seeds must be at least 1, got {seeds}", "seeds")
    plots.require()
    render.require()
    prepared = photographs(found, seeds, out)
    train = partial(runner.run_pairs, at_once=jobs, scheduler=scheduler)
    cells = _train(found, lights, seeds, prepared, out / "runs", tuple(changes), train)
    clipping = {path.name: clipped(path) for path in dict.fromkeys(prepared.values())}
    write_text(out / "stress.json", result_text(_record(cells, clipping, changes)))
    write_text(out / "stress.md", report.markdown(cells))
    plots.save_figure(report.plot(cells), out / "stress")
    return out / "stress.md"


def photographs(found: Iterable[Axis], seeds: int, out: Path) -> dict[tuple[Level, int], Path]:
    """The data sets of all levels and seeds; equal ones are one folder."""
    scenes: dict[Spec, Path] = {}
    data: dict[tuple[Spec, Damage, int], Path] = {}
    result = {}
    for axis in found:
        for level in axis.levels:
            spec, damage = level.spec, level.damage
            name = f"{axis.name}-{level.label}"
            if spec not in scenes:
                place = out / "scenes" / ("base" if spec == BASE else name)
                scenes[spec] = _rendered(spec, place)
            if damage.light and SECOND not in scenes:
                scenes[SECOND] = _rendered(SECOND, out / "scenes" / "base-second")
            for seed in range(seeds):
                key = (spec, damage, seed if level.random else 0)
                if key not in data:
                    same = (spec, damage) == (BASE, INTACT)
                    own = "base" if same else f"{name}-s{seed}" if level.random else name
                    second = scenes[SECOND] if damage.light else None
                    data[key] = _damaged(
                        scenes[spec], spec, damage, seed, second, out / "data" / own
                    )
                result[level, seed] = data[key]
    return result


def setting(light: LightName, seed: int, level: Level, changes: tuple[str, ...] = ()) -> Setting:
    """A training by steps that takes less than half a minute on two cores."""
    own = (*SMALL, *(SMALL_HYBRID if light == "hybrid" else ()), f"seed={seed}")
    varying = "".join(f"-{c.rpartition('=')[2]}" for c in level.changes)
    name = f"{light}{varying}-s{seed}"
    return Setting(name, "draft", light, MINUTES, (*own, *level.changes, *changes))


def _lights(names: Sequence[str]) -> tuple[LightName, ...]:
    if unknown := [name for name in names if name not in LIGHTS]:
        raise UserError(f"light must be of {', '.join(LIGHTS)}, got {', '.join(unknown)}", "light")
    return tuple(light for light in LIGHTS if light in names)


def _train(
    found: Sequence[Axis],
    lights: Sequence[LightName],
    seeds: int,
    data: dict[tuple[Level, int], Path],
    out: Path,
    changes: tuple[str, ...],
    train: Callable[..., list[Outcome]],
) -> list[Cell]:
    """Every level under every light, all seeds; what no configuration follows from is refused."""
    wanted: dict[tuple[Path, str], Setting] = {}
    done: dict[tuple[Path, str], Outcome] = {}
    cells: list[tuple[Axis, Level, LightName]] = [
        (axis, level, light) for axis in found for light in lights for level in axis.levels
    ]
    for _, level, light in cells:
        for seed in range(seeds):
            place, one = data[level, seed], setting(light, seed, level, changes)
            try:
                one.config(place, out)
            except UserError as error:
                if not level.changes:
                    raise  # a mistake in `changes`
                refused = Outcome(place.name, one.name, {}, error=f"{_name(error)}: {error}")
                done[place, one.name] = refused
            else:
                wanted[place, one.name] = one
    pairs = [(place, one) for (place, _), one in wanted.items()]
    trained = train(pairs, out, SAMPLES)
    done |= dict(zip(wanted, trained, strict=True))

    def outcomes(level: Level, light: LightName) -> tuple[Outcome, ...]:
        names = [(data[level, s], setting(light, s, level).name) for s in range(seeds)]
        return tuple(done[key] for key in names)

    return [Cell(axis, level, light, outcomes(level, light)) for axis, level, light in cells]


def _rendered(spec: Spec, place: Path) -> Path:
    if not render.rendered(spec, place):
        log.info("rendering %s", place.name)
    return render.render(spec, place)


def _damaged(
    scene: Path, spec: Spec, damage: Damage, seed: int, second: Path | None, place: Path
) -> Path:
    """The photographs, unless they are there."""
    fields = {"spec": asdict(spec), "damage": asdict(damage), "seed": seed}
    identity = json.dumps(fields, indent=1) + "\n"
    path = place / IDENTITY
    if path.exists():
        if path.read_text(encoding="utf-8") != identity:
            raise UserError(
                f"{path}: made from other photographs: choose another folder for out", "out"
            )
        return place
    damaged(scene, place, damage, seed, second)
    path.write_text(identity, encoding="utf-8")
    return place


def _name(error: UserError) -> str:
    """The exception as the last line of a traceback names it."""
    return f"{type(error).__module__}.{type(error).__qualname__}"


def _relit(measures: Mapping[str, float | int | None]) -> dict[str, float | int | None]:
    """The measure that breaking points are judged by; runs/ keeps all of them."""
    return {key: measures[key] for key in (plots.RELIT.key,) if key in measures}


def _record(cells: Sequence[Cell], clipping: dict[str, float], changes: Sequence[str]) -> dict:
    """All of it as JSON."""
    rows = []
    for cell in cells:
        keys = dict.fromkeys(key for o in cell.outcomes for key in o.measures)
        scene = cell.outcomes[0].scene
        rows.append(
            {
                "axis": cell.axis.name,
                "level": cell.level.label,
                "light": cell.light,
                "fault": cell.fault(),
                "clipped": clipping[scene],
                "mean": {key: cell.mean(key) for key in keys},
                "spread": {key: cell.spread(key) for key in keys},
                "outcomes": [
                    {"scene": o.scene, "setting": o.setting, "error": o.error, **_relit(o.measures)}
                    for o in cell.outcomes
                ],
            }
        )
    points = [
        {
            "axis": axis,
            "light": light,
            "value": None if b is None else b.value,
            "between": None if b is None else [b.before.label, b.after.label],
        }
        for (axis, light), b in report.breaks(cells).items()
    ]
    return {
        "machine": plots.machine(),
        "changes": list(changes),
        "counts": report.counts(cells),
        "breaking_points": points,
        "axes": {
            c.axis.name: {
                "title": c.axis.title,
                "levels": [level.label for level in c.axis.levels],
                "reference": c.axis.levels[c.axis.reference].label,
            }
            for c in cells
        },
        "rows": rows,
    }
