"""Process many scenes on one machine or a cluster."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from univoxel.cli import parsing
from univoxel.cli.train import TrainOptions
from univoxel.core import choices, log, machine
from univoxel.core.files import read_json
from univoxel.errors import ProcessFailed, UserError, demand

if TYPE_CHECKING:
    from rich.table import Table

    from univoxel.batch.jobs import Job, Result, Step
    from univoxel.batch.scenes import SceneResult
    from univoxel.config import TrainConfig


# Options of what is done with each scene: those of a later sitting agree but for the steps
EACH = ("steps", "masks", "preset", "light", "minutes", "config", "changes", "samples")


@dataclass(frozen=True, kw_only=True)
class BatchOptions:
    scenes: parsing.Scenes
    """folders of photographs, one for each scene; their names must differ"""
    out: Annotated[Path, parsing.written("NIGHT")]
    """folder to write to"""
    steps: Annotated[tuple[choices.BatchStep, ...], parsing.written("STEP [STEP ...]")] = (
        choices.USUAL_STEPS
    )
    """steps to run for each scene, in this order: poses masks train eval export page"""
    masks: Annotated[str, parsing.written("auto|rembg|FOLDER|none")] = "auto"
    """source of the masks in the step masks; see capture --masks"""
    preset: choices.PresetOrAuto = "auto"
    """amount of work, from draft to best; auto: what fits in --minutes, else fast"""
    light: Annotated[choices.LightName, parsing.ADVANCED] = "hybrid"
    """lighting model; hybrid keeps shadows out of the albedo; the others are baselines"""
    minutes: parsing.Minutes = None
    """time limit for training each scene"""
    config: parsing.ConfigFile = None
    """reuse the config.json of another run instead of --preset and --light"""
    changes: parsing.Changes = ()
    """change one configuration field, such as loss.radiance=0.5; repeatable"""
    samples: Annotated[int, parsing.ADVANCED] = choices.SAMPLES
    """number of light samples per pixel in relit test images"""
    jobs: Annotated[int | None, parsing.written("N", "as cores and memory allow")] = None
    """number of scenes to process at a time, each with --threads or a share of cores"""
    scheduler: parsing.Scheduler = None
    """Dask scheduler to use; anyone who can reach it can run code on its workers"""
    tries: Annotated[int, parsing.ADVANCED] = 3
    """maximum number of attempts at a scene whose process is killed"""
    json: parsing.JsonFile = None
    """also write batch.json to this file; use - to print it instead of the table"""

    def training(self) -> TrainConfig:
        """The configuration of a training; a UserError if there is none of that kind."""
        names = "preset", "light", "minutes", "config", "changes"
        chosen = {name: getattr(self, name) for name in names}
        return TrainOptions(data=Path(), out=Path(), **chosen).configuration()

    def identity(self, data: Path) -> dict[str, Any]:
        """What a later sitting must agree with to continue; JSON. Steps may be added."""
        said = {name: getattr(self, name) for name in EACH[1:]} | {"data": str(data)}
        if self.config is not None:
            said["config"] = read_json(self.config)
        return json.loads(json.dumps(said, default=str))

    def words(self) -> list[str]:
        """The options of train."""
        words = ["--preset", self.preset, "--light", self.light]
        if self.config is not None:
            words = ["--config", str(self.config.absolute())]
        words += [] if self.minutes is None else ["--minutes", f"{self.minutes:g}"]
        return [*words, *(f"--set={change}" for change in self.changes)]


@parsing.takes(BatchOptions)
def command(asked: BatchOptions) -> None:
    """Process many scenes, on one machine or a cluster.

    Each step of a scene runs in its own process, so a crash does not affect the other scenes.
    Finished steps are kept: run the same command again to resume, or to retry failed scenes.
    NIGHT/index.html shows all scenes, and batch.json and batch.csv list their metrics. The results
    of a scene are in NIGHT/SCENE, and all logs in NIGHT/logs. If a scene fails, the exit code is 2.
    """
    import rich

    parsing.check_minutes(asked.minutes)
    with parsing.json_file(asked.json) as file:
        results = batch(replace(asked, json=file), machine.threads_asked())
    if asked.json != parsing.STDOUT:
        rich.print(table(results))
        print(asked.out / "index.html")
    check(results)


def batch(asked: BatchOptions, threads: int | None = None) -> list[SceneResult]:
    """Process scenes, each step in its own process; return the results in order.

    index.html, batch.json and batch.csv list all scenes and are updated when one ends.

    Args:
        threads: threads per scene; None: as the machine allows.

    Raises:
        UserError: an argument cannot be used, Dask is missing, or out holds scenes that were
            processed with other options; nothing was started.
        ProcessFailed: the scheduler does not answer, or the connection was lost.
        OSError: out cannot be written.
    """
    from univoxel.batch.jobs import connect, run_jobs
    from univoxel.batch.scenes import named, result_of, share, write_results, write_sheet

    unknown = [step for step in asked.steps if step not in choices.BATCH_STEPS]
    if unknown or not asked.steps:
        got = ", ".join(unknown) or "none"
        raise UserError(f"steps must be among {', '.join(choices.BATCH_STEPS)}, got {got}", "steps")
    numbers = {"jobs": asked.jobs, "threads": threads}
    numbers |= {"tries": asked.tries, "samples": asked.samples}
    for name, number in numbers.items():
        demand(number is None or number >= 1, name, "at least 1", number)
    known, config = named(asked.scenes), asked.training()
    jobs, out = asked.jobs, asked.out
    if asked.scheduler is None:
        here = (machine.cores(), machine.memory())
        jobs, threads = share(known.values(), config, *here, jobs, threads)
        log.info("%d scenes at a time, with %d threads each", jobs, threads)
    elif jobs is not None:
        raise UserError("expected jobs or scheduler, but not both", "jobs", "scheduler")
    every = [job_of(name, data, asked, threads) for name, data in known.items()]
    for job in every:
        job.check_same()
    ended: dict[str, Result] = {}

    def write(other: Path | None = None) -> list[SceneResult]:
        results = [result_of(job, known[job.name], out, ended.get(job.name)) for job in every]
        options = {name: getattr(asked, name) for name in EACH}
        write_results(results, options, out, other)
        write_sheet(results, out)
        return results

    with connect(jobs or 1, asked.scheduler) as client:
        out.mkdir(parents=True, exist_ok=True)
        before = {result.name for result in write() if result.state == "done"}
        missing = [job for job in every if job.name not in before]
        for found in run_jobs(client, missing, len(every), asked.tries):
            ended[found.name] = found
            if found.state == "done":
                log.info("%s: done in %.0f s", found.name, found.seconds)
            for step, said in found.errors.items():
                log.warning("%s: failed in %s: %s", found.name, step, said)
            try:
                write()
            except OSError as error:  # the disk may have room again when the last one ends
                log.warning("%s", error)
    return write(None if asked.json is None else Path(asked.json))


def job_of(name: str, data: Path, asked: BatchOptions, threads: int | None) -> Job:
    """The steps of a scene, data (absolute), that are asked for, below the folder of a batch."""
    from univoxel.batch.jobs import Job, Step
    from univoxel.batch.scenes import LOGS, MEASURED
    from univoxel.capture.project import Project
    from univoxel.capture.scene import REPORT
    from univoxel.scene import FILE
    from univoxel.training.progress import LOG

    out = asked.out.absolute()
    project = Project(out / name)
    # Photographs that bring masks are not written again
    before = [project.cut] if "masks" in asked.steps else []
    before += [project.scene] if {"poses", "masks"} & set(asked.steps) else []
    run, checkpoint, measures = str(project.run), project.run / FILE, project.out / MEASURED
    trained, log = project.run / "trust.txt", project.run / LOG
    capture = ("capture", str(data), "--out", str(project.out), "--masks", asked.masks, "--until")
    train = ("--out", run, "--resume", "--no-page", *asked.words())
    evaluate = ("eval", run, "--json", str(measures), "--samples", str(asked.samples))
    page = ("view", run, "--html", str(project.page), "--title", name)
    export = ("export", run, "--mesh", str(project.mesh))

    def step(name: choices.BatchStep, *words: str | tuple[Path, ...], **fields: Any) -> Step:
        return Step(name, ("-m", "univoxel.cli", *words), **fields)

    def aside(name: choices.BatchStep, words: Sequence[str], makes: Path) -> Step:
        return step(name, *words, makes=makes, after=checkpoint, needed=False)

    every = (
        step("poses", *capture, "cameras", unless=(project.scene / REPORT, trained)),
        step("masks", *capture, "masks", unless=(project.cut, trained)),
        step("train", "train", (*before, data), *train, makes=trained, after=checkpoint, log=log),
        aside("eval", evaluate, measures),
        aside("export", export, project.mesh),
        aside("page", page, project.page),
    )
    steps = tuple(step for step in every if step.name in asked.steps)
    return Job(name, steps, out / LOGS / name, asked.identity(data), threads)


def check(results: Sequence[SceneResult]) -> None:
    """Raise a ProcessFailed where scenes failed."""
    failed = [result.name for result in results if result.state != "done"]
    if failed:
        raise ProcessFailed(
            f"{len(failed)} of {len(results)} scenes failed ({', '.join(failed)}): run the same "
            "command again to retry them"
        )


def table(results: Sequence[SceneResult]) -> Table:
    """What came out, as the command prints it."""
    from rich.table import Table

    rows = Table("scene", "state", "verdict")
    for head in ("novel views, dB", "expected albedo error", "seconds"):
        rows.add_column(head, justify="right")
    rows.add_column("error")
    for r in results:
        quality, error = r.measures.get("nvs_psnr"), r.expected.get("albedo_error")
        numbers = ("-" if quality is None else f"{quality:.1f}", f"{sum(r.seconds.values()):.0f}")
        expected = "-" if error is None else f"{error:.2f}"
        rows.add_row(r.name, r.state, r.verdict or "-", numbers[0], expected, numbers[1], r.error)
    return rows
