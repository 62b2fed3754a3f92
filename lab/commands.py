"""Commands of the laboratory, called `univoxel lab compare`, `chart` and so on."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, TypeAlias

from univoxel.cli.parsing import (
    AtOnce,
    Changes,
    Command,
    Minutes,
    Run,
    Scenes,
    Scheduler,
    check_minutes,
    written,
)
from univoxel.core.choices import BOUNCES, LIGHTS, SAMPLES, LightName, PresetName, PresetOrAuto

Half: TypeAlias = Literal["tuning", "judging"]


def submit(
    run: Run,
    /,
    out: Annotated[Path, written("DIR")],
    samples: Annotated[int, written("N")] = SAMPLES,
    bounces: Annotated[int, written("N")] = BOUNCES,
) -> None:
    """Write what the benchmark of Stanford-ORB measures, of a run.

    The run was trained on a scene of it.

    Args:
        run: folder of a trained run
        out: folder to write; its submission.json lists the files, as scripts/test.py of the
            benchmark reads it
        samples: light samples per pixel of relit pictures
        bounces: reflections between parts of the object in relit pictures, 0 for none
    """
    from lab import submit as task

    print(task.submit(run, out, samples, bounces))


def compare(
    scenes: Scenes,
    /,
    out: Annotated[Path, written("DIR")],
    preset: PresetOrAuto = "auto",
    light: Annotated[tuple[str, ...], written("LIGHT [LIGHT ...]")] = LIGHTS,
    minutes: Minutes = None,
    samples: int = SAMPLES,
    set: Changes = (),
    jobs: AtOnce = 1,
    scheduler: Scheduler = None,
) -> None:
    """Train scenes with every model of light, side by side.

    Writes DIR/compare.md, compare.json, compare.png and compare.svg. Every training is kept in
    DIR/SCENE/LIGHT with all its measures (result.json); the same command again goes on after an
    interruption and tries again what failed. Trainings run one after another, each in a process of
    its own: leave the machine to them, or their times say little.

    Args:
        scenes: folders of photographs
        out: folder for the results
        preset: how much work goes into each training, as of train
        light: models of light, as of train --light; sg:lobes=12 changes a field of the light's
            configuration, sg:lobes=12,hidden=32 two
        minutes: wall-clock limit of each training, above 0
        samples: of the light, per pixel of relit pictures
        set: one field of the configuration of all trainings, as of train
        jobs: trainings at once; with more than one, their times say little
        scheduler: of a Dask cluster whose workers train, as of batch
    """
    from lab import compare as experiment

    check_minutes(minutes)
    where = {"jobs": jobs, "scheduler": scheduler}
    print(experiment.compare(scenes, out, preset, light, minutes, set, samples, **where))


def chart(
    scenes: Scenes,
    /,
    out: Annotated[Path, written("DIR")],
    preset: PresetName = "fast",
    light: LightName = "hybrid",
    quick: bool = False,
    only: Annotated[tuple[str, ...], written("SETTING [SETTING ...]", "all")] = (),
    samples: int = SAMPLES,
    set: Changes = (),
    jobs: AtOnce = 1,
    scheduler: Scheduler = None,
) -> None:
    """Draw quality against training time, of presets and knobs.

    Trains draft, fast, full, best, and --preset with one knob turned: voxels-x0.5 (half the voxels
    of the finest grid), voxels-x2, rays-x0.5 (half the rays of a step), rays-x2, steps-,
    directions- and lobes- alike, light-sg and so on. Writes DIR/chart.png, chart.svg and chart.json
    with every measure, the log of each training, and the Pareto front of each measure: settings
    that no other beats in both time and quality. Published figures, of other data and of GPUs, are
    marked. Trainings are kept, and gone on with, as of compare.

    Args:
        scenes: folders of photographs
        out: folder for the results
        preset: what the knobs are turned around
        light: of the presets and the knobs
        quick: five settings instead of all
        only: names of settings
        samples: of the light, per pixel of relit pictures
        set: one field of the configuration of all trainings, as of train
        jobs: trainings at once; with more than one, their times say little
        scheduler: of a Dask cluster whose workers train, as of batch
    """
    from lab import chart as experiment

    where = {"jobs": jobs, "scheduler": scheduler}
    print(experiment.chart(scenes, out, preset, light, quick, only, set, samples, **where))


def stress(
    out: Annotated[Path, written("DIR")],
    quick: bool = False,
    only: Annotated[tuple[str, ...], written("AXIS [AXIS ...]", "all")] = (),
    light: Annotated[
        tuple[str, ...],
        written("LIGHT [LIGHT ...]", "sg sh envmap hybrid; with --quick: hybrid"),
    ] = (),
    seeds: Annotated[int | None, written("N", "3; with --quick: 1")] = None,
    set: Changes = (),
    jobs: AtOnce = 1,
    scheduler: Scheduler = None,
) -> None:
    """Find out where the method breaks, on scenes of known truth.

    Renders small scenes with Mitsuba 3, made harder along one axis each, spoils their photographs,
    trains and measures. Writes DIR/stress.md with the breaking point of each axis, stress.json,
    stress.png and stress.svg.
    Axes: roughness, metal, concavity, sun, views, pose, exposure, light, masks, rough-masks, thin,
    fur, turntable, noise, placement, dark, bright; light-varying is trained with --varying light.
    A training that fails is a result. What is done is kept: the same command goes on.

    Args:
        out: folder for scenes, photographs, trainings and results
        quick: fewer severities of each axis
        only: names of axes
        light: models of light, as of train
        seeds: trainings of each level, with other random numbers
        set: one field of the configuration of all trainings, as of train
        jobs: trainings at once; with more than one, their times say little
        scheduler: of a Dask cluster whose workers train, as of batch
    """
    from lab.stress import suite

    where = {"jobs": jobs, "scheduler": scheduler}
    print(suite.stress(out, only, light, seeds, quick, set, **where))


def bank(
    out: Annotated[Path | None, written("DIR", "~/.cache/univoxel/bank")] = None,
    render: bool = False,
    judge: bool = False,
    half: Half | None = None,
    scenes: Annotated[int, written("N")] = 64,
    seed: Annotated[int, written("N")] = 0,
    label: Annotated[str, written("NAME")] = "draft",
    preset: PresetName = "draft",
    set: Changes = (),
    jobs: AtOnce = 1,
) -> None:
    """Measure decisions, on random scenes of known truth.

    Renders random objects, materials, light and captures with Mitsuba 3, trains on each, and says
    how good results are in the mean, which share of decisions is right, and whether doubt foretells
    errors. Half of the scenes are to tune with, half to judge with; the seed says which, for good.
    Writes DIR/seed-N/judge-NAME.md and .json. What is done is kept: the same command goes on.

    Args:
        out: folder for scenes and trainings
        render: only render what is missing
        judge: only print what trainings so far say
        half: of the scenes; both when left out
        scenes: how many, of both halves together
        seed: of the scenes
        label: of the trainings, to keep those of several versions apart
        preset: how much work goes into each training, as of train
        set: one field of the configuration of all trainings, as of train
        jobs: trainings at once
    """
    from lab.bank import suite

    work = {"preset": preset, "changes": set, "jobs": jobs}
    print(suite.bank(out, render, judge, half, scenes, seed, label, **work))


def published(
    folder: Annotated[Path, written("DIR", positional=True)],
    /,
    out: Annotated[Path, written("DIR")],
    preset: PresetName = "fast",
    set: Changes = (),
    jobs: AtOnce = 1,
) -> None:
    """Train on public data sets that you have, and print their tables.

    Finds scenes of Synthetic4Relight, TensoIR-Synthetic, Shiny Blender and Stanford-ORB, trains on
    each, and prints a table per data set with the metrics of its papers and what differs from
    their protocol. Writes published.md and published.json too. The same command resumes after an
    interruption. Nobody has run it on the real data sets yet.

    Args:
        folder: folder that holds the data sets, or one scene
        out: folder for trainings and tables
        preset: how much work goes into each training
        set: configuration field of all trainings, as in train --set
        jobs: trainings at the same time
    """
    from lab import published as experiment

    print(experiment.published(folder, out, preset, set, jobs).read_text("utf-8"))


COMMANDS: dict[str, Command] = {
    "compare": compare,
    "chart": chart,
    "stress": stress,
    "bank": bank,
    "submit": submit,
    "published": published,
}
