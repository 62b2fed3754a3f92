"""Scenes of a batch as jobs: their steps as command lines, and how many run at once."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from univoxel.capture.project import Project
from univoxel.capture.scene import REPORT
from univoxel.checkpoint import FILE
from univoxel.config import TrainConfig, load_config
from univoxel.data.images import image_size
from univoxel.data.shots import LARGE
from univoxel.errors import UserError
from univoxel.files import read_json
from univoxel.jobs.job import Job, Step
from univoxel.machine import Memory
from univoxel.names import SAMPLES, USUAL_STEPS, BatchStep, LightName, PresetOrAuto
from univoxel.overrides import changed
from univoxel.presets import chosen
from univoxel.training.memory import needed_for
from univoxel.training.progress import LOG

MEASURED = "measures.json"  # in the folder of a scene
LOGS = "logs"  # the folder in a batch's of what processes said, records and locks
PICTURES = {".png", ".jpg", ".jpeg", ".exr"}
PER_PROCESS = 600_000_000  # bytes: Python, torch and what is loaded around them
PER_PIXEL = 7  # bytes of a photograph and its alpha


@dataclass(frozen=True)
class BatchOptions:
    """What is to be done with each scene."""

    steps: tuple[BatchStep, ...] = USUAL_STEPS
    masks: str = "auto"  # where they come from, as of capture
    preset: PresetOrAuto = "auto"
    light: LightName = "hybrid"
    minutes: float | None = None  # of each training; None: it makes all steps of the preset
    config: Path | None = None  # a file that says all of a training, in place of a preset
    changes: tuple[str, ...] = ()  # FIELD=VALUE of the configuration
    samples: int = SAMPLES  # of the light, per pixel of relit pictures that are measured

    def training(self) -> TrainConfig:
        """The configuration of a training.

        Raises:
            UserError: there is none of that kind.
        """
        if self.config is None:
            config = chosen(self.preset, self.minutes, Path(), Path(), self.light)
            return changed(config, self.changes)
        if (self.preset, self.light) != ("auto", "hybrid"):
            raise UserError(
                f"expected config or preset and light, got both: {self.config} says them", "config"
            )
        config = load_config(self.config)
        minutes = config.minutes if self.minutes is None else self.minutes
        return changed(replace(config, minutes=minutes), self.changes)

    def identity(self, data: Path) -> dict[str, Any]:
        """What a later sitting must agree with to go on; JSON. Steps may be added."""
        fields = asdict(self) | {"data": str(data)}
        del fields["steps"]
        if self.config is not None:
            fields["config"] = read_json(self.config)
        return json.loads(json.dumps(fields, default=str))

    def words(self) -> list[str]:
        """The options of train."""
        words = ["--preset", self.preset, "--light", self.light]
        if self.config is not None:
            words = ["--config", str(self.config.absolute())]
        words += [] if self.minutes is None else ["--minutes", f"{self.minutes:g}"]
        return [*words, *(f"--set={change}" for change in self.changes)]


def named(scenes: Sequence[Path]) -> dict[str, Path]:
    """Absolute paths of scenes by the names of their folders.

    Raises:
        UserError: none, two of one name, one that is not there, or one of a name that is taken.
    """
    found: dict[str, Path] = {}
    for path in (scene.resolve() for scene in scenes):
        name = path.stem if path.is_file() else path.name
        if not path.exists():
            raise UserError(f"{path}: expected a scene, got nothing there")
        if name == LOGS or name.startswith("."):
            raise UserError(f"{path}: expected another name than {name!r}: rename the folder")
        if name in found:
            both = f"{found[name]} and {path}"
            raise UserError(f"expected scenes in folders of different names, got {both}")
        found[name] = path
    if not found:
        raise UserError("expected a scene, a folder of photographs, or more; got none")
    return found


def job_of(name: str, data: Path, out: Path, options: BatchOptions, threads: int | None) -> Job:
    """The steps of a scene, data (absolute), that are asked for, below the folder of a batch."""
    out = out.absolute()
    project = Project(out / name)
    # Photographs that bring masks are not written again
    before = [project.cut] if "masks" in options.steps else []
    before += [project.scene] if {"poses", "masks"} & set(options.steps) else []
    run, checkpoint, measures = str(project.run), project.run / FILE, project.out / MEASURED
    trained, log = project.run / "trust.txt", project.run / LOG
    capture = ("capture", str(data), "--out", str(project.out), "--masks", options.masks, "--until")
    train = ("--out", run, "--resume", "--no-page", *options.words())
    evaluate = ("eval", run, "--json", str(measures), "--samples", str(options.samples))
    page = ("view", run, "--html", str(project.page), "--title", name)
    export = ("export", run, "--mesh", str(project.mesh))

    def step(name: BatchStep, *words: str | tuple[Path, ...], **fields: Any) -> Step:
        return Step(name, ("-m", "univoxel.cli", *words), **fields)

    def aside(name: BatchStep, words: Sequence[str], makes: Path) -> Step:
        return step(name, *words, makes=makes, after=checkpoint, needed=False)

    every = (
        step("poses", *capture, "cameras", unless=(project.scene / REPORT, trained)),
        step("masks", *capture, "masks", unless=(project.cut, trained)),
        step("train", "train", (*before, data), *train, makes=trained, after=checkpoint, log=log),
        aside("eval", evaluate, measures),
        aside("export", export, project.mesh),
        aside("page", page, project.page),
    )
    steps = tuple(step for step in every if step.name in options.steps)
    return Job(name, steps, out / LOGS / name, options.identity(data), threads)


def share(
    scenes: Collection[Path],
    config: TrainConfig,
    cores: float,
    memory: Memory | None,
    jobs: int | None = None,
    threads: int | None = None,
) -> tuple[int, int]:
    """Scenes at once, and threads of each, as cores and memory of a machine allow.

    Threads of one training wait for one another, processes do not: many of few threads do more.

    Args:
        jobs, threads: what is decided already, >= 1.
    """
    whole = max(int(cores), 1)
    if jobs is None:
        jobs = min(max(whole // (threads or 1), 1), len(scenes))
        if memory is not None and jobs > 1:
            left = memory.total if memory.free is None else memory.free
            jobs = max(min(jobs, left // max(bytes_of(data, config) for data in scenes)), 1)
    return jobs, threads or max(whole // jobs, 1)


def bytes_of(data: Path, config: TrainConfig) -> int:
    """Memory, about, of a training on the pictures below a folder."""
    pixels = 0
    for path in data.rglob("*"):
        if path.suffix.lower() in PICTURES:
            with contextlib.suppress(UserError):
                width, height = image_size(path)
                pixels += width * height
    pixels = min(pixels, LARGE) // max(config.downscale, 1) ** 2
    return PER_PROCESS + PER_PIXEL * pixels + needed_for(pixels, config)
