"""The bank of random scenes: render, train, judge."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lab import runner
from lab.bank import measure, scenes
from lab.bank.scenes import COUNT, HALVES, Half
from lab.record import RESULT, Outcome, Setting, load_outcome, result_text
from lab.stress import render
from univoxel.core import log
from univoxel.core.files import read_json, replacing
from univoxel.errors import UserError

PRESET = "draft"
SAMPLES = 64  # of the light, per pixel of relit pictures
JUDGED = "judged.json"  # beside a training's result.json


def folder_of(out: Path | None, seed: int) -> Path:
    """Where the bank of a seed lies; with `out` None, among what programs keep for a user."""
    kept = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return (out or kept / "univoxel" / "bank") / f"seed-{seed}"


def bank(
    out: Path | None = None,
    render_only: bool = False,
    judge_only: bool = False,
    half: Half | None = None,
    count: int = COUNT,
    seed: int = 0,
    label: str = PRESET,
    preset: str = PRESET,
    changes: Sequence[str] = (),
    jobs: int = 1,
) -> Path:
    """Render scenes, train on them, or say how well they were trained on.

    Args:
        out: folder of banks; see `folder_of`.
        render_only, judge_only: one of these steps; neither: render what is missing, train, judge.
        half: of the scenes; both when None.
        count: of the scenes of both halves, the first, >= 1.
        seed: of what the scenes are; those of another seed are other scenes.
        label: of trainings that are kept beside others, such as in another version.
        preset, changes: of the trainings, as in train.
        jobs: trainings at once.

    Returns:
        The scenes' folder, or the tables: judge-LABEL.md, with judge-LABEL.json beside it.

    Raises:
        UserError: an argument cannot be used, or what is kept is of other scenes or settings.
        MissingExtra, ProcessFailed: Mitsuba is missing, or failed.
        OSError: a file cannot be written.
    """
    if render_only and judge_only:
        raise UserError("expected render or judge, got both", "render", "judge")
    if count < 1 or seed < 0:
        raise UserError(
            f"scenes must be at least 1 and seed at least 0, got {count} and {seed}",
            *("scenes", "seed"),
        )
    place = folder_of(out, seed)
    chosen = scenes.chosen(seed, count, half)
    folders = [place / "scenes" / scenes.name_of(index) for index in chosen]
    if not judge_only:
        for index, folder in zip(chosen, folders, strict=True):
            _rendered(seed, index, folder)
    if render_only:
        return place / "scenes"
    runs = place / "runs"
    if judge_only:
        found = {folder: load_outcome(runs / folder.name / label) for folder in folders}
        outcomes = {folder: outcome for folder, outcome in found.items() if outcome is not None}
        if not outcomes:
            raise UserError(f"{runs}: expected trainings named {label}, found none: train first")
    else:
        setting = Setting(label, preset, changes=tuple(changes))
        pairs = [(folder, setting) for folder in folders]
        outcomes = dict(
            zip(folders, runner.run_pairs(pairs, runs, SAMPLES, at_once=jobs), strict=True)
        )
    told = {data: _judged(data, runs / data.name / label, one) for data, one in outcomes.items()}
    return _written(place / f"judge-{label}", outcomes, told, seed)


def _rendered(seed: int, index: int, folder: Path) -> None:
    if not render.holds(scenes.identity(seed, index), folder):
        log.info("rendering %s", folder.name)
        folder.parent.mkdir(parents=True, exist_ok=True)
        scenes.render_scene(seed, index, folder)


def _judged(data: Path, kept: Path, outcome: Outcome) -> dict[str, Any] | None:
    """What a training decided, kept beside its result; None if it failed."""
    if outcome.error:
        return None
    path = kept / JUDGED
    if path.exists() and path.stat().st_mtime >= (kept / RESULT).stat().st_mtime:
        return read_json(path)
    found = measure.judged(kept / "run", data)
    measure.save(path, found)
    return found


def _written(
    stem: Path,
    outcomes: dict[Path, Outcome],
    told: dict[Path, dict[str, Any] | None],
    seed: int,
) -> Path:
    """Write and print the tables."""
    half_of = {data: scenes.half_of(seed, int(data.name.rpartition("-")[2])) for data in outcomes}
    halves = {}
    for half in HALVES:
        own = [data for data in outcomes if half_of[data] == half]
        if own:
            halves[half] = measure.summary([outcomes[d] for d in own], [told[d] for d in own])
    text = measure.markdown(halves)
    rows = [
        {"scene": data.name, "half": half_of[data], **outcome.summary(), "judged": told[data]}
        for data, outcome in outcomes.items()
    ]
    for row in rows:
        del row["log"]
    with replacing(stem.with_suffix(".json")) as temporary:
        temporary.write_text(result_text({"halves": halves, "rows": rows}), encoding="utf-8")
    with replacing(stem.with_suffix(".md")) as temporary:
        temporary.write_text(text, encoding="utf-8")
    log.info(text)
    if failed := runner.failures(list(outcomes.values())):
        log.info(failed)
    return stem.with_suffix(".md")
