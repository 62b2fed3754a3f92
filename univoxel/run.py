"""The folder of a run: the data it was trained on, and the verdict on the result."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from univoxel.core.files import read_json, write_json
from univoxel.data import Photos, keep_photos, load_photos
from univoxel.errors import DataError, UserError


@dataclass(frozen=True)
class Source:
    """Photographs that a run was trained on."""

    folder: Path
    downscale: int  # pixels of the files along a side of one that was trained on
    allow_outside: bool  # as in `load_photos`


def kept_photos(run: Path, split: str) -> Path:
    """The file of a run that stores the prepared photographs of a split."""
    return run / f"photographs_{split}.safetensors"


def trained_on(run: Path) -> Path:
    """The data set that a run's config.json names."""
    return _source_of(run).folder


def photos_of(run: Path, data: Path | None = None, split: str = "test") -> Photos:
    """Photographs at the size that a run was trained at.

    Args:
        data: another data set; None: the one that the run was trained on.
        split: "test" or "train".

    Raises:
        DataError: the run or the photographs cannot be read.
    """
    if data is not None and not (run / "config.json").is_file():
        return load_photos(data, split)
    source = _source_of(run)
    size, outside = source.downscale, source.allow_outside
    if data is not None and data != source.folder:
        return load_photos(data, split, size, allow_outside=outside)
    kept = kept_photos(run, split)
    photos = load_photos(source.folder, split, size, kept=kept, allow_outside=outside)
    keep_photos(photos, kept)
    return photos


WORLD = "world.json"  # in the folder of a run whose world is not that of its data's files


def save_world(moved: np.ndarray | None, run: Path) -> None:
    """Write the transform from the world of the data's files to that of the run, as in `Photos`."""
    (run / WORLD).unlink(missing_ok=True)
    if moved is not None:
        write_json(run / WORLD, {"from_data": moved.tolist()})


def load_world(run: Path) -> np.ndarray | None:
    """[3, 4], as in `Photos.moved`; None also of runs of earlier versions, which kept none. A
    DataError if the file cannot be read."""
    path = run / WORLD
    if not path.is_file():
        return None
    try:
        moved = np.array(read_json(path)["from_data"], np.float64)
    except (KeyError, TypeError, ValueError, OverflowError):
        moved = np.empty(0)
    if moved.shape != (3, 4) or not np.isfinite(moved).all():
        raise DataError(f"{path}: expected from_data, a 3x4 matrix of rotation and translation")
    return moved


def _source_of(run: Path) -> Source:
    """What photographs a run's config.json says that it was trained on."""
    path = run / "config.json"
    if not path.is_file():
        raise DataError(f"{run}: expected the folder of a run, but {path.name} is missing")
    config = read_json(path)
    if not isinstance(config, dict):
        raise DataError(f"{path}: expected a JSON object of settings, got {config!r:.80}")
    # In runs from before there was a choice
    before = {"downscale": 0, "allow_outside": False}
    values = before | config
    match values:
        case {"data": str(data), "downscale": int(downscale), "allow_outside": bool(outside)} if (
            data and "\0" not in data and downscale >= 0 and not isinstance(downscale, bool)
        ):
            # 0 in runs from before a size was chosen for large photographs: those were refused
            return Source(Path(data), downscale or 1, outside)
    raise DataError(
        f"{path}: expected data to be a folder and downscale to be at least 0, got "
        f"{values.get('data')!r:.80} and {values.get('downscale')!r:.80}"
    )


# The verdict on a run, from evidence: good, usable, retake or unfinished.


FILE = "verdict.json"  # in the folder of a run
Word = Literal["good", "usable", "retake", "unfinished"]

# Validation PSNR, dB, over pixels of the object and around it that training did not see. Rendered
# scenes and clean captures reach 28 and more; below 20 a picture shows another object
GOOD_DB, POOR_DB = 26.0, 20.0
# Share of the validation pixels that lie on the other side of the silhouette than their masks say
GOOD_OUTLINE, POOR_OUTLINE = 0.03, 0.10
# Shares of the surface: too few cameras see it; it differs visibly from its photographs
GOOD_HIDDEN, POOR_HIDDEN = 0.25, 0.6
GOOD_RESIDUAL, POOR_RESIDUAL = 0.15, 0.8


@dataclass(frozen=True)
class Evidence:
    """The evidence for a verdict; None: not measured."""

    steps: Mapping[str, float]  # share of the steps that were run, by name of each shortened stage
    stopped: bool = False  # whether training was stopped by hand
    minutes: float | None = None  # minutes that all steps would have needed
    limit: float | None = None  # time limit in minutes; None: there was none
    psnr: float | None = None  # PSNR of validation pixels, dB
    outline: float | None = None  # share of validation pixels on the wrong side of the silhouette
    hidden: float | None = None  # share of the surface that too few cameras see
    residual: float | None = None  # share of the surface that differs from its photographs
    troubles: int = 0  # number of failures from which training recovered


@dataclass(frozen=True)
class Verdict:
    """The quality of a run in one word, with reasons and remedies."""

    word: Word
    complete: bool  # whether all planned steps were run
    reasons: tuple[str, ...]  # reasons against the verdict "good", the worst first
    remedies: tuple[str, ...]  # at most two suggestions, the most helpful first
    evidence: Evidence

    @property
    def empty(self) -> bool:
        """Whether a stage made no step at all, so that its result is missing."""
        return any(made == 0 for made in self.evidence.steps.values())

    def lines(self) -> list[str]:
        """The verdict, and a line with the remedies, if there are any."""
        psnr = self.evidence.psnr
        quality = () if psnr is None else (f"validation PSNR {psnr:.1f} dB",)
        said = f"Result: {self.word}"
        if told := "; ".join(self.reasons or quality):
            said += f", {told}"
        remedies = "; or ".join(self.remedies)
        return [said, f"To improve it: {remedies}"] if remedies else [said]

    def sentence(self) -> str:
        """The verdict and its remedies in one paragraph."""
        return ". ".join(self.lines())


def judge(evidence: Evidence) -> Verdict:
    """The verdict that evidence leads to."""
    faults: list[tuple[bool, str, str]] = []  # whether it is poor, the reason, the remedy

    # What is measured, what of it is good and poor, the reason against it, the remedy. If good is
    # above poor, more is better; NaN is poor
    measured = (
        (
            *(evidence.psnr, GOOD_DB, POOR_DB),
            f"validation PSNR {{:.1f}} dB ({GOOD_DB:g} or more is good)",
            "take sharp photographs with one exposure, and do not move the object or the light",
        ),
        (
            *(evidence.outline, GOOD_OUTLINE, POOR_OUTLINE),
            "{:.0%} of the validation pixels contradict the masks",
            "correct the masks",
        ),
        (
            *(evidence.hidden, GOOD_HIDDEN, POOR_HIDDEN),
            "{:.0%} of the surface is seen by too few cameras",
            "take more photographs from the directions that `univoxel report` shows",
        ),
        (
            *(evidence.residual, GOOD_RESIDUAL, POOR_RESIDUAL),
            "{:.0%} of the surface differs visibly from its photographs",
            "train with `--preset full`, if the masks are correct and the object did not move",
        ),
    )
    for value, good, poor, reason, remedy in measured:
        sign = 1 if good > poor else -1
        if value is not None and not sign * value >= sign * good:
            faults.append((not sign * value >= sign * poor, reason.format(value), remedy))
    if evidence.troubles:
        times = "once" if evidence.troubles == 1 else f"{evidence.troubles} times"
        faults.append((False, f"training failed {times} and recovered", "try another `--seed`"))
    faults.sort(key=lambda found: not found[0])
    word: Word = "good" if not faults else "retake" if faults[0][0] else "usable"
    reasons = [reason for _, reason, _ in faults]
    remedies = [remedy for _, _, remedy in faults]
    if evidence.steps:
        word = "unfinished"
        made = ", ".join(f"{share:.0%} of {name}" for name, share in evidence.steps.items())
        why = "training was stopped" if evidence.stopped else "the time limit was too short"
        reasons.insert(0, f"{why} (completed steps: {made})")
        needed = None if evidence.minutes is None else math.ceil(evidence.minutes)
        if evidence.stopped or evidence.limit is None:
            remedies.insert(0, "resume the training with `--resume`")
        elif needed is not None:
            remedies.insert(
                0, f"train with `--minutes {max(needed, math.floor(evidence.limit) + 1)}`"
            )
    remedies = list(dict.fromkeys(remedies))[:2]
    return Verdict(word, not evidence.steps, tuple(reasons), tuple(remedies), evidence)


def save_verdict(verdict: Verdict, run: Path) -> None:
    """Write the verdict to verdict.json in the run's folder, whole or not at all."""
    write_json(run / FILE, as_json(verdict))


def as_json(verdict: Verdict) -> dict[str, Any]:
    """`complete`, `verdict`, `reasons`, `remedies`, `evidence`."""
    values = json.loads(json.dumps(asdict(verdict)))  # lists for tuples
    return {"complete": values.pop("complete"), "verdict": values.pop("word"), **values}


def load_verdict(run: Path) -> Verdict | None:
    """The verdict on a run; None if training has not ended, or is older than version 0.3."""
    try:
        values = read_json(run / FILE)
        evidence = Evidence(**values["evidence"])
    except (OSError, UserError, LookupError, TypeError):
        return None
    return judge(evidence)
