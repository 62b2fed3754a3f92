"""Many scenes, each through the same steps, on one machine or on a cluster; what came out."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.table import Table

from univoxel import machine
from univoxel.batch.results import SceneResult, as_json, result_of, write_results
from univoxel.batch.scenes import LOGS, Wanted, named, piece_of, share
from univoxel.batch.sheet import write_sheet
from univoxel.cluster.drive import drive
from univoxel.cluster.machines import machines, require
from univoxel.cluster.piece import Ended, Piece, load_record
from univoxel.errors import ExistingFile, ProcessFailed, UserError
from univoxel.files import replacing
from univoxel.names import BATCH_STEPS

USUAL = Wanted()

log: logging.Logger = logging.getLogger("univoxel")


def batch(
    scenes: Sequence[Path],
    out: Path,
    wanted: Wanted = USUAL,
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
    anew as each ends. What is done is not done again; what was killed goes on from where it was
    saved. A scene that fails takes no other with it.

    Args:
        scenes: folders of photographs, of different names; or videos.
        jobs: scenes at once, on this machine; None: as cores and memory allow.
        threads: of each; None: a share of the cores.
        scheduler: address of a scheduler of Dask, whose workers do it; they see the same folders.
        tries: how often a scene whose process is killed is tried before it counts as failed.
        json: another file for what batch.json holds.

    Raises:
        UserError: an argument cannot be used; nothing was begun.
        MissingExtra: Dask is missing.
        ExistingFile: out holds scenes that other options made.
        ProcessFailed: the scheduler does not answer, or is gone.
        OSError: out cannot be written.
    """
    require()
    _check(wanted, jobs, threads, tries)
    known = named([Path(scene) for scene in scenes])
    config = wanted.training(Path(), Path())
    if scheduler is None:
        here = share(known, config, machine.cores(), machine.memory(), jobs, threads)
        jobs, threads = here.jobs, here.threads
        log.info("scenes at once: %d, threads of each: %d", jobs, threads)
    elif jobs is not None:
        raise UserError("expected jobs or scheduler, got both", "jobs", "scheduler")
    pieces = [piece_of(name, data, out, wanted, threads) for name, data in known.items()]
    for piece in pieces:
        _check_same(piece)
    (out / LOGS).mkdir(parents=True, exist_ok=True)
    before = {p.name: result_of(p, known[p.name], out) for p in pieces}
    missing = [piece for piece in pieces if before[piece.name].state != "done"]
    options = dataclasses.asdict(wanted)
    ended: dict[str, Ended] = {}
    with machines(jobs or 1, scheduler) as client:
        for found in drive(client, missing, len(pieces), tries):
            ended[found.name] = found
            _tell(found)
            try:
                _write(_results(pieces, known, out, ended), options, out)
            except OSError as error:  # the disk may have room again when the last one ends
                log.warning("%s", error)
    results = _results(pieces, known, out, ended)
    _write(results, options, out)
    if json is not None:
        with replacing(json) as temporary:
            temporary.write_text(as_json(results, options), encoding="utf-8")
    return results


def check(results: Sequence[SceneResult]) -> None:
    """Refuse a batch in which scenes failed.

    Raises:
        ProcessFailed: some did.
    """
    failed = [result for result in results if result.state != "done"]
    if failed:
        raise ProcessFailed(
            f"{len(failed)} of {len(results)} scenes failed ({', '.join(r.name for r in failed)}): "
            "the same command tries them again"
        )


def table(results: Sequence[SceneResult]) -> Table:
    """What came out, as the command prints it."""
    rows = Table("scene", "state", "novel views, dB", "doubt of albedo", "seconds", "error")
    for result in results:
        quality, doubt = result.measures.get("nvs_psnr"), result.doubts.get("doubt_albedo")
        rows.add_row(
            result.name,
            result.state,
            "-" if quality is None else f"{quality:.1f}",
            "-" if doubt is None else f"{doubt:.2f}",
            f"{sum(result.seconds.values()):.0f}",
            result.error,
        )
    for column in rows.columns[2:5]:
        column.justify = "right"
    return rows


def _check(wanted: Wanted, jobs: int | None, threads: int | None, tries: int) -> None:
    """Refuse what is out of range.

    Raises:
        UserError: something is.
    """
    unknown = [step for step in wanted.steps if step not in BATCH_STEPS]
    if unknown or not wanted.steps:
        raise UserError(
            f"steps must be of {', '.join(BATCH_STEPS)}, got {', '.join(unknown) or 'none'}",
            "steps",
        )
    numbers = {"jobs": jobs, "threads": threads, "tries": tries, "samples": wanted.samples}
    for name, number in numbers.items():
        if number is not None and number < 1:
            raise UserError(f"{name} must be at least 1, got {number}", name)


def _check_same(piece: Piece) -> None:
    """Refuse to go on with a scene that other options began.

    Raises:
        ExistingFile: they are others.
    """
    before = load_record(piece.record).identity
    other = [key for key, value in piece.identity.items() if before and before.get(key) != value]
    if other:
        raise ExistingFile(
            f"{piece.name}: {piece.record} is of another {' and '.join(other)}: choose another "
            "out, or remove that file and the scene's folder",
            "out",
        )


def _results(
    pieces: Sequence[Piece], known: Mapping[str, Path], out: Path, ended: Mapping[str, Ended]
) -> list[SceneResult]:
    return [result_of(p, known[p.name], out, ended.get(p.name)) for p in pieces]


def _write(results: Sequence[SceneResult], options: Mapping, out: Path) -> None:
    write_results(results, options, out)
    write_sheet(results, out)


def _tell(found: Ended) -> None:
    """Say how a scene ended, in a line."""
    if found.state == "done":
        log.info("%s: done in %.0f s", found.name, found.seconds)
        return
    for step, said in found.errors.items():
        log.warning("%s: failed in %s: %s", found.name, step, said)
