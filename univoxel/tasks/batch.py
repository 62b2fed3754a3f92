"""Many scenes, each through the same steps, on one machine or on a cluster; what came out."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from pathlib import Path

from rich.table import Table

from univoxel import machine
from univoxel.batch.results import SceneResult, result_of, write_results
from univoxel.batch.scenes import BatchOptions, job_of, named, share
from univoxel.batch.sheet import write_sheet
from univoxel.errors import ProcessFailed, UserError
from univoxel.jobs.job import Result
from univoxel.jobs.scheduler import connect, run_jobs
from univoxel.names import BATCH_STEPS

USUAL = BatchOptions()

log: logging.Logger = logging.getLogger("univoxel")


def batch(
    scenes: Sequence[Path],
    out: Path,
    options: BatchOptions = USUAL,
    *,
    jobs: int | None = None,
    threads: int | None = None,
    scheduler: str | None = None,
    tries: int = 3,
    json: Path | None = None,
) -> list[SceneResult]:
    """Take scenes through steps, each in processes of its own; return what came out, in order.

    Below `out` each scene has a folder with run/, measures.json, a mesh and a page; logs/ holds
    what processes said. index.html, batch.json and batch.csv tell of all of them, and are written
    anew as each ends. What is done is not done again. A scene that fails takes no other with it.

    Args:
        scenes: folders of photographs, of different names; or videos.
        jobs, threads: scenes at once on this machine, and of each; None: as it allows.
        scheduler: address of a scheduler of Dask, whose workers do it; they see the same folders.
        tries: how often a scene whose process is killed is tried before it counts as failed.
        json: another file for what batch.json holds.

    Raises:
        UserError: an argument cannot be used, Dask is missing, or out holds scenes that other
            options made; nothing was begun.
        ProcessFailed: the scheduler does not answer, or is gone.
        OSError: out cannot be written.
    """
    unknown = [step for step in options.steps if step not in BATCH_STEPS]
    if unknown or not options.steps:
        got = ", ".join(unknown) or "none"
        raise UserError(f"steps must be of {', '.join(BATCH_STEPS)}, got {got}", "steps")
    numbers = {"jobs": jobs, "threads": threads, "tries": tries, "samples": options.samples}
    for name, number in numbers.items():
        if number is not None and number < 1:
            raise UserError(f"{name} must be at least 1, got {number}", name)
    known, config = named([Path(scene) for scene in scenes]), options.training()
    if scheduler is None:
        here = (machine.cores(), machine.memory())
        jobs, threads = share(known.values(), config, *here, jobs, threads)
        log.info("scenes at once: %d, threads of each: %d", jobs, threads)
    elif jobs is not None:
        raise UserError("expected jobs or scheduler, got both", "jobs", "scheduler")
    every = [job_of(name, data, out, options, threads) for name, data in known.items()]
    for job in every:
        job.check_same()
    ended: dict[str, Result] = {}

    def write(other: Path | None = None) -> list[SceneResult]:
        results = [result_of(job, known[job.name], out, ended.get(job.name)) for job in every]
        write_results(results, dataclasses.asdict(options), out, other)
        write_sheet(results, out)
        return results

    with connect(jobs or 1, scheduler) as client:
        out.mkdir(parents=True, exist_ok=True)
        before = {result.name for result in write() if result.state == "done"}
        missing = [job for job in every if job.name not in before]
        for found in run_jobs(client, missing, len(every), tries):
            ended[found.name] = found
            if found.state == "done":
                log.info("%s: done in %.0f s", found.name, found.seconds)
            for step, said in found.errors.items():
                log.warning("%s: failed in %s: %s", found.name, step, said)
            try:
                write()
            except OSError as error:  # the disk may have room again when the last one ends
                log.warning("%s", error)
    return write(json)


def check(results: Sequence[SceneResult]) -> None:
    """Refuse a batch in which scenes failed.

    Raises:
        ProcessFailed: some did.
    """
    failed = [result.name for result in results if result.state != "done"]
    if failed:
        raise ProcessFailed(
            f"{len(failed)} of {len(results)} scenes failed ({', '.join(failed)}): "
            "the same command tries them again"
        )


def table(results: Sequence[SceneResult]) -> Table:
    """What came out, as the command prints it."""
    rows = Table("scene", "state", "verdict")
    for head in ("novel views, dB", "doubt of albedo", "seconds"):
        rows.add_column(head, justify="right")
    rows.add_column("error")
    for r in results:
        quality, doubt = r.measures.get("nvs_psnr"), r.doubts.get("doubt_albedo")
        numbers = ("-" if quality is None else f"{quality:.1f}", f"{sum(r.seconds.values()):.0f}")
        doubts = "-" if doubt is None else f"{doubt:.2f}"
        rows.add_row(r.name, r.state, r.verdict or "-", numbers[0], doubts, numbers[1], r.error)
    return rows
