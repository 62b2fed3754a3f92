"""Commands for experiments, called `univoxel lab compare`, `chart` and so on."""

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
    """Write the files that the Stanford-ORB benchmark evaluates.

    The run must have been trained on a scene of the benchmark.

    Args:
        run: folder of a trained run
        out: folder to write to; the benchmark's scripts/test.py reads its submission.json
        samples: light samples per pixel of relit images
        bounces: light bounces between parts of the object in relit images
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
    """Train scenes with every lighting model and compare the results.

    Writes DIR/compare.md, compare.json, compare.png and compare.svg. DIR/SCENE/LIGHT keeps each
    training run with its metrics (result.json). To resume, or to retry failed runs, run the same
    command again. Scenes are trained one after another, each in its own process. Do not run
    anything else meanwhile, because that would distort the times.

    Args:
        scenes: folders of photographs
        out: folder to write to
        preset: amount of work, from draft to best
        light: lighting models; sg:lobes=12,hidden=32 also sets two fields of sg
        minutes: time limit of each training run
        samples: light samples per pixel of relit images
        set: change one configuration field of all training runs; repeatable
        jobs: number of training runs at a time; more than one distorts the times
        scheduler: Dask scheduler to use; anyone who can reach it can run code on its workers
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
    seeds: Annotated[int, written("N")] = 1,
    set: Changes = (),
    jobs: AtOnce = 1,
    scheduler: Scheduler = None,
) -> None:
    """Plot quality against training time, for presets and variants.

    Trains draft, fast, full and best, and variants of --preset that change one setting:
    voxels-x0.5 (half the voxels of the finest grid), voxels-x2, rays-x0.5 (half the rays per step),
    rays-x2, the same for steps, directions and lobes, and light-NAME for other lighting models.
    Writes DIR/chart.png, chart.svg and chart.json with every metric, the log of each training run,
    and the Pareto front of each metric. Finished runs are kept: run the same command again to
    resume.

    Args:
        scenes: folders of photographs
        out: folder to write to
        preset: preset to vary
        light: lighting model of all settings except light-NAME
        quick: train five settings instead of all
        only: names of the settings to train
        samples: light samples per pixel of relit images
        seeds: training runs of --preset per scene, with different random seeds; the results show
            their medians
        set: change one configuration field of all training runs; repeatable
        jobs: number of training runs at a time; more than one distorts the times
        scheduler: Dask scheduler to use; anyone who can reach it can run code on its workers
    """
    from lab import chart as experiment

    where = {"jobs": jobs, "scheduler": scheduler}
    print(experiment.chart(scenes, out, preset, light, quick, only, set, samples, seeds, **where))


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
    """Find the limits of the method, on scenes with ground truth.

    Renders small scenes with Mitsuba 3, in which one property (the axis) becomes harder from level
    to level, then trains on each and measures the result. Writes DIR/stress.md with the breaking
    point of each axis, stress.json, stress.png and stress.svg.
    Axes: roughness, metal, concavity, sun, views, pose, exposure, light, masks, rough-masks, thin,
    fur, turntable, noise, placement, dark, bright; light-varying is trained with --varying light.
    A failed training run counts as a result. Finished runs are kept: run the same command again to
    resume.

    Args:
        out: folder for scenes, photographs, training runs and results
        quick: test fewer levels of each axis
        only: names of the axes to run
        light: lighting models
        seeds: training runs per level, with different random seeds
        set: change one configuration field of all training runs; repeatable
        jobs: number of training runs at a time; more than one distorts the times
        scheduler: Dask scheduler to use; anyone who can reach it can run code on its workers
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
    """Measure quality and automatic decisions on random scenes.

    Renders random objects, materials, light and captures with Mitsuba 3 and trains on each. Reports
    the mean quality, the share of correct decisions, and how true expected errors are. One
    half of the scenes is for tuning and the other for judging; the seed determines which. Writes
    DIR/seed-N/judge-NAME.md and .json. Finished runs are kept: run the same command again to
    resume.

    Args:
        out: folder for scenes and training runs
        render: only render the missing scenes
        judge: only print the results of finished training runs
        half: half of the scenes to use; both if omitted
        scenes: total number of scenes in the two halves
        seed: random seed of the scenes
        label: name of these training runs, which keeps several versions apart
        preset: amount of work, from draft to best
        set: change one configuration field of all training runs; repeatable
        jobs: number of training runs at a time
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
    """Train on your copies of public data sets, and print a table for each.

    Finds scenes of Synthetic4Relight, TensoIR-Synthetic, Shiny Blender and Stanford-ORB, and trains
    on each. The table of a data set has the metrics of its papers and lists the differences from
    their protocol. Also writes published.md and published.json. Finished runs are kept: run the
    same command again to resume. The command has not been run on the real data sets yet.

    Args:
        folder: folder that contains the data sets, or one scene
        out: folder for training runs and tables
        preset: amount of work, from draft to best
        set: change one configuration field of all training runs; repeatable
        jobs: number of training runs at a time
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
