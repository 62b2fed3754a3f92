"""A scene of a batch as a piece of work: its steps as command lines, and what each makes."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from univoxel.capture.project import Project
from univoxel.capture.scene import REPORT
from univoxel.checkpoint import FILE
from univoxel.cluster.piece import FirstOf, Piece, Step
from univoxel.config import TrainConfig, load_config
from univoxel.data.images import image_size
from univoxel.data.shots import LARGE
from univoxel.errors import UserError
from univoxel.files import read_json
from univoxel.machine import Memory
from univoxel.names import (
    BATCH_STEPS,
    SAMPLES,
    USUAL_STEPS,
    BatchStep,
    LightName,
    PresetOrAuto,
)
from univoxel.overrides import changed
from univoxel.presets import chosen
from univoxel.training.clock import expected_training
from univoxel.training.memory import needed_for
from univoxel.training.progress import LOG

LOGS = "logs"  # the folder in a batch's of what processes said, records and locks
MODULE = ("-m", "univoxel.cli")
# Seconds that steps may take besides training, guesses for the bar
GUESSES = {"poses": 240.0, "masks": 60.0, "eval": 40.0, "export": 15.0, "page": 15.0}
PICTURES = {".png", ".jpg", ".jpeg", ".exr"}
PER_PROCESS = 600_000_000  # bytes: Python, torch and what is loaded around them
PER_PIXEL = 7  # bytes of a photograph and its alpha


@dataclass(frozen=True)
class Wanted:
    """What is to be done with each scene."""

    steps: tuple[BatchStep, ...] = USUAL_STEPS
    masks: str = "auto"  # where they come from, as of capture
    preset: PresetOrAuto = "auto"
    light: LightName = "hybrid"
    # of each training; None: the preset's, in which it makes all steps
    minutes: float | None = None
    config: Path | None = None  # a file that says all of a training, in place of a preset
    changes: tuple[str, ...] = ()  # FIELD=VALUE of the configuration
    samples: int = SAMPLES  # of the light, per pixel of relit pictures that are measured

    def training(self, data: Path, out: Path) -> TrainConfig:
        """The configuration of a training.

        Raises:
            UserError: there is none of that kind.
        """
        if self.config is None:
            configuration = chosen(self.preset, self.minutes, data, out, self.light)
        elif (self.preset, self.light) != ("auto", "hybrid"):
            raise UserError(
                f"expected config or preset and light, got both: {self.config} says them", "config"
            )
        else:
            configuration = replace(load_config(self.config), data=data, out=out)
            if self.minutes is not None:
                configuration = replace(configuration, minutes=self.minutes)
        return changed(configuration, self.changes)

    def identity(self, data: Path) -> dict[str, Any]:
        """What a later sitting must agree with to go on; JSON. Steps may be added."""
        fields = asdict(self) | {"data": str(data)}
        del fields["steps"]
        if self.config is not None:
            fields["config"] = read_json(self.config)
        return json.loads(json.dumps(fields, default=str))


def named(scenes: Sequence[Path]) -> dict[str, Path]:
    """Absolute paths of scenes by the names of their folders.

    Raises:
        UserError: none, two of one name, one that is not there, or one of a name that is taken.
    """
    if not scenes:
        raise UserError("expected a scene, a folder of photographs, or more; got none")
    found: dict[str, Path] = {}
    for scene in scenes:
        path = scene.resolve()
        if not path.exists():
            raise UserError(f"{scene}: expected a scene, got nothing there")
        name = path.stem if path.is_file() else path.name
        if name == LOGS or name.startswith("."):
            raise UserError(f"{scene}: expected another name than {name!r}: rename the folder")
        if name in found:
            raise UserError(
                f"expected scenes in folders of different names, got {found[name]} and {path}"
            )
        found[name] = path
    return found


def piece_of(name: str, data: Path, out: Path, wanted: Wanted, threads: int | None) -> Piece:
    """The steps of a scene that are wanted, in their order.

    Args:
        data: absolute.
        out: the folder of the batch; the scene's is below it.
        threads: as of `Piece`.
    """
    out = out.absolute()
    project, logs = Project(out / name), out / LOGS
    steps = _steps(project, data, wanted)
    seconds = sum(GUESSES.get(step, 0.0) for step in wanted.steps)
    if "train" in wanted.steps:
        seconds += expected_training(wanted.training(data, project.run))
    return Piece(
        name,
        tuple(steps[step] for step in BATCH_STEPS if step in wanted.steps),
        lock=logs / f"{name}.lock",
        output=logs / f"{name}.txt",
        record=logs / f"{name}.json",
        identity=wanted.identity(data),
        threads=threads,
        seconds=seconds,
    )


def measures_file(project: Project) -> Path:
    """Where the measures of a scene lie."""
    return project.out / "measures.json"


def _steps(project: Project, data: Path, wanted: Wanted) -> dict[BatchStep, Step]:
    """All the steps that there are."""
    run, checkpoint, measures = str(project.run), project.run / FILE, measures_file(project)
    capture = (*MODULE, "capture", str(data), "--out", str(project.out), "--masks", wanted.masks)
    before = [project.cut] if "masks" in wanted.steps else []
    before += [project.scene] if {"poses", "masks"} & set(wanted.steps) else []
    found = FirstOf((*before, data))
    train = (
        *MODULE,
        "train",
        found,
        "--out",
        run,
        "--resume",
        "--no-page",
        *_training(wanted),
    )
    evaluate = (*MODULE, "eval", run, "--json", str(measures), "--samples", str(wanted.samples))
    page = (*MODULE, "view", run, "--html", str(project.page), "--title", project.out.name)
    export = (*MODULE, "export", run, "--mesh", str(project.mesh))
    aside: dict[str, Any] = {"after": checkpoint, "needed": False}
    trained = project.run / "trust.txt"
    return {
        "poses": Step(
            "poses",
            (*capture, "--until", "cameras"),
            unless=(project.scene / REPORT, trained),
        ),
        # Photographs that bring masks are not written again
        "masks": Step("masks", (*capture, "--until", "masks"), unless=(project.cut, trained)),
        "train": Step("train", train, trained, checkpoint, log=project.run / LOG),
        "eval": Step("eval", evaluate, measures, **aside),
        "export": Step("export", export, project.mesh, **aside),
        "page": Step("page", page, project.page, **aside),
    }


def _training(wanted: Wanted) -> list[str]:
    """The options of train."""
    if wanted.config is not None:
        options = ["--config", str(wanted.config.absolute())]
    else:
        options = ["--preset", wanted.preset, "--light", wanted.light]
    if wanted.minutes is not None:
        options += ["--minutes", f"{wanted.minutes:g}"]
    return [*options, *(f"--set={change}" for change in wanted.changes)]


@dataclass(frozen=True)
class Share:
    """How a machine is shared among trainings."""

    jobs: int  # at once
    threads: int  # of each


def share(
    scenes: Mapping[str, Path],
    config: TrainConfig,
    cores: float,
    memory: Memory | None,
    jobs: int | None = None,
    threads: int | None = None,
) -> Share:
    """A share for each of as many scenes at once as cores and memory allow.

    Threads of one training wait for one another, processes do not: many of few threads do more.

    Args:
        cores, memory: of the machine, as of `univoxel.machine`.
        jobs, threads: what is decided already, >= 1.
    """
    whole = max(int(cores), 1)
    if jobs is None:
        jobs = min(max(whole // (threads or 1), 1), len(scenes))
        if memory is not None and jobs > 1:
            left = memory.total if memory.free is None else memory.free
            most = max(bytes_of(data, config) for data in scenes.values())
            jobs = min(jobs, max(int(left // most), 1))
    return Share(jobs, threads or max(whole // jobs, 1))


def bytes_of(data: Path, config: TrainConfig) -> int:
    """Memory, about, of a training on the pictures in a folder."""
    pixels = min(sum(_pixels(folder) for folder in _folders(data)), LARGE)
    pixels //= max(config.downscale, 1) ** 2
    return PER_PROCESS + PER_PIXEL * pixels + needed_for(pixels, config)


def _folders(data: Path) -> Iterable[Path]:
    """A folder and those below it."""
    yield data
    if data.is_dir():
        yield from (path for path in data.rglob("*") if path.is_dir())


def _pixels(folder: Path) -> int:
    """Of the pictures in a folder, if all are as large as the first that can be read."""
    if not folder.is_dir():
        return 0
    files = [path for path in sorted(folder.iterdir()) if path.suffix.lower() in PICTURES]
    for path in files:
        try:
            width, height = image_size(path)
        except UserError:
            continue
        return width * height * len(files)
    return 0
