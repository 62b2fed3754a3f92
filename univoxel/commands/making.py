"""Commands that make a run from photographs: capture, poses, cutout, train, batch."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import rich
from tyro.conf import Positional, arg

from univoxel.commands.arguments import (
    STDOUT,
    Changes,
    ConfigFile,
    Host,
    JsonFile,
    Megabytes,
    Minutes,
    Port,
    Scenes,
    Scheduler,
    Seed,
    TimelapseFile,
    check_downscale,
    check_minutes,
    json_file,
)
from univoxel.errors import ExistingFile, UserError
from univoxel.machine import threads_asked
from univoxel.names import (
    FEATURE_SIZE,
    KEEP_SIZE,
    SAMPLES,
    USUAL_STEPS,
    BatchStep,
    CamerasFrom,
    CapacityOrAuto,
    Differing,
    Downscale,
    FieldName,
    LightFrameOrAuto,
    LightName,
    MasksFrom,
    Metal,
    PresetOrAuto,
    Until,
)

if TYPE_CHECKING:
    from univoxel.config import TrainConfig


@dataclass(frozen=True)
class Choices:
    """Options of train that a preset is made into a configuration with."""

    preset: PresetOrAuto = "auto"
    light: LightName = "hybrid"
    varying: Differing = "auto"
    light_frame: LightFrameOrAuto = "auto"
    metal: Metal = "auto"
    masks: MasksFrom = "auto"
    cameras: CamerasFrom = "auto"
    field: FieldName = "hash"
    capacity: CapacityOrAuto = "auto"
    budget_mb: float | None = None

    def configuration(self, minutes: float | None, data: Path, out: Path) -> TrainConfig:
        """What they amount to."""
        from univoxel.presets import chosen, with_field, with_metal

        config = chosen(self.preset, minutes, data, out, self.light, self.varying)
        config = replace(config, masks=self.masks, cameras=self.cameras)
        config = with_metal(with_field(config, self.field), self.metal)
        if self.light_frame != "auto":
            config = replace(config, light_frame=self.light_frame)
        fits = self.budget_mb is not None and self.capacity == "auto"
        capacity = "adaptive" if fits else self.capacity
        if capacity == "auto":
            return config
        return replace(config, capacity=capacity, budget_mb=self.budget_mb)


def configuration_of(
    file: Path | None, choices: Choices, minutes: float | None, data: Path, out: Path
) -> TrainConfig:
    """The configuration in a file, for other photographs; without one, what the choices amount to.

    Raises:
        UserError: the file cannot be read, or a choice was made that it makes itself; or minutes
            are not above 0.
    """
    check_minutes(minutes)
    if file is None:
        return choices.configuration(minutes, data, out)
    from univoxel.config import load_config

    for field in fields(choices):
        if (value := getattr(choices, field.name)) != field.default:
            option = f"--{field.name.replace('_', '-')} {value}"
            raise UserError(f"expected --config or {option}, got both: {file} says it")
    config = replace(load_config(file), data=data, out=out)
    return config if minutes is None else replace(config, minutes=minutes)


def tell_run(run: Path, no_page: bool) -> int:
    """Print where a trained run lies, with its page if it gets one; return the exit code."""
    from univoxel.tasks.view import with_page

    print(run if no_page else with_page(run))
    return code_of(run)


def code_of(run: Path) -> int:
    """The exit code of a training: 3 where a stage made no step at all, or else 0."""
    from univoxel.verdict import load_verdict

    verdict = load_verdict(run)
    return 3 if verdict is not None and verdict.empty else 0


def view_at(view: bool, host: str | None, port: int | None) -> tuple[str, int] | None:
    """Host and port that a training is looked at, if at all.

    Raises:
        UserError: one is given, and it is not.
    """
    if view:
        return "127.0.0.1" if host is None else host, 8080 if port is None else port
    if host is not None or port is not None:
        option = f"--host {host}" if host is not None else f"--port {port}"
        raise UserError(f"expected --view with {option}, got that alone")
    return None


def train(
    data: Annotated[Positional[Path], arg(metavar="DATA")],
    /,
    out: Annotated[Path, arg(metavar="RUN")],
    preset: PresetOrAuto = "auto",
    light: LightName = "hybrid",
    varying: Differing = "auto",
    light_frame: LightFrameOrAuto = "auto",
    metal: Metal = "auto",
    masks: MasksFrom = "auto",
    cameras: CamerasFrom = "auto",
    downscale: Annotated[Downscale, arg(metavar="auto|N")] = "auto",
    field: FieldName = "hash",
    minutes: Minutes = None,
    capacity: CapacityOrAuto = "auto",
    budget_mb: Megabytes = None,
    allow_outside: bool = False,
    resume: bool = False,
    timelapse: TimelapseFile = None,
    view: bool = False,
    host: Host = None,
    port: Port = None,
    seed: Seed = None,
    config: ConfigFile = None,
    set: Changes = (),
    no_page: bool = False,
) -> int:
    """Recover geometry, materials and light from posed photographs.

    Args:
        data: folder of the photographs and their cameras
        out: folder that the run is written to
        preset: how much work goes in: draft is a look, 1 minute on two cores, fast the usual, 2,
            full finer, 5, best the finest, 8; auto is what fits into --minutes, or else fast
        light: sg, local lobes as published; hybrid, then one environment map with traced
            visibility, which cleans shadows from the albedo; others to compare with: sh and mlp,
            local too, envmap-sg and envmap, one map from the beginning, and baked, none: the
            photographs' colours are taken for albedo, as a photogrammetry mesh has them
        varying: what differs from photograph to photograph: exposure, with the colour balance, or
            the light itself too; auto is exposure where it is seen to differ, else none
        light_frame: world, where the light stood still, or turntable, where it turned with the
            camera; auto is what explains the photographs better
        metal: all, if the whole object is metal, patina included; some, if not; auto decides it
        masks: auto takes masks in that end outside of the object, as the photographs show it
        cameras: refined puts the photographs' cameras right, before training and in it; auto does
            so where their silhouettes contradict one another
        downscale: train on photographs of 1/N of their width and height; auto is as large as
            leaves what grids can use, 1 below 1500 pixels
        field: hash takes features from a small table of many resolutions; dense stores them at
            every node of the grid, sparse in bricks around the surface alone, for finer grids than
            the presets', such as --set stages.1.voxels=30
        minutes: wall-clock limit, above 0, from the first photograph read to the end: what does not
            fit is cut, in all stages alike; without, all steps are made, however long they take
        capacity: adaptive makes no larger a model than the scene needs, as held-out pixels tell:
            fewer rows of features, fewer levels of mirrored directions, fewer nodes far from the
            surface. auto is that, but fixed for sparse fields and for lights other than hybrid
        budget_mb: most megabytes of the model's file; implies --capacity adaptive
        allow_outside: read photographs outside of DATA too, where its files or links name such
        resume: go on with the run in --out; where nothing was saved yet, it begins
        timelapse: picture of a test view over training time, or a folder of its frames
        view: look at the training in a browser while it goes, and end it early
        host: address that --view listens on
        port: port that --view listens on
        seed: of all random choices
        config: config.json of another run, to train these photographs alike: it says all that
            --preset, --light and such would; --minutes, --seed, --downscale and --set go before it
        set: for experts: one field of the configuration, such as loss.radiance=0.5 or
            stages.1.voxels=3; config.json in a run's folder holds them all
        no_page: write no RUN/index.html at the end
    """
    from univoxel.overrides import changed
    from univoxel.tasks import train as task

    watched = {"timelapse": timelapse, "view": view_at(view, host, port)}
    if not resume and (out / "scene.safetensors").exists():
        raise ExistingFile(f"{out} holds a run already: add --resume, or choose another --out")
    of_preset = preset, light, varying, light_frame, metal, masks, cameras, field, capacity
    asked = configuration_of(config, Choices(*of_preset, budget_mb), minutes, data, out)
    asked = replace(asked, downscale=check_downscale(downscale), allow_outside=allow_outside)
    asked = asked if seed is None else replace(asked, seed=seed)
    return tell_run(task.train(changed(asked, set), resume=resume, **watched), no_page)


def batch(
    scenes: Scenes,
    /,
    out: Annotated[Path, arg(metavar="NIGHT")],
    steps: Annotated[tuple[BatchStep, ...], arg(metavar="STEP [STEP ...]")] = USUAL_STEPS,
    jobs: Annotated[
        int | None, arg(metavar="N", help_behavior_hint="(default: as cores and memory allow)")
    ] = None,
    scheduler: Scheduler = None,
    preset: PresetOrAuto = "auto",
    light: LightName = "hybrid",
    minutes: Minutes = None,
    config: ConfigFile = None,
    set: Changes = (),
    masks: Annotated[str, arg(metavar="auto|rembg|FOLDER|none")] = "auto",
    samples: int = SAMPLES,
    tries: Annotated[int, arg(metavar="N")] = 3,
    json: JsonFile = None,
) -> None:
    """Take many scenes through training, measures, mesh and page, on one machine or a cluster.

    Each scene has processes of its own: one that crashes, or that the system ends, takes no other
    with it. What is done is kept: the same command goes on after an interruption, and tries again
    what failed. NIGHT/index.html shows all scenes, batch.json and batch.csv hold their measures,
    NIGHT/SCENE has what was made, NIGHT/logs what was said. Ends with exit code 2 where a scene
    failed.

    Args:
        scenes: folders of photographs, of different names
        out: folder to write
        steps: of each scene: train eval export page; before them poses masks, for photographs
            without cameras or masks, as capture makes them
        jobs: scenes at once; each runs on --threads, or its share of the cores
        scheduler: of a Dask cluster whose workers take the scenes, such as tcp://10.0.0.1:8786;
            they see the same folders. Whoever reaches a scheduler can run programs on its workers
        preset: as of train
        light: as of train
        minutes: wall-clock limit of each training, above 0
        config: as of train
        set: as of train
        masks: as of capture, for the step masks
        samples: of the light, per pixel of relit pictures that are measured
        tries: how often a scene whose process is killed is tried before it counts as failed
        json: another file for what batch.json holds; - prints it in place of the table
    """
    from univoxel.batch.scenes import BatchOptions
    from univoxel.tasks import batch as task

    check_minutes(minutes)
    options = BatchOptions(steps, masks, preset, light, minutes, config, set, samples)
    how = {"jobs": jobs, "threads": threads_asked(), "scheduler": scheduler, "tries": tries}
    with json_file(json) as file:
        results = task.batch(scenes, out, options, **how, json=file)
    if json != STDOUT:
        rich.print(task.table(results))
        print(out / "index.html")
    task.check(results)


def cutout(
    data: Annotated[Positional[Path], arg(metavar="DATA")],
    /,
    out: Annotated[Path, arg(metavar="DIR")],
    source: Annotated[
        str, arg(name="from", metavar="rembg|FOLDER|none", help_behavior_hint="(default: rembg)")
    ] = "rembg",
    downscale: Annotated[Downscale, arg(metavar="auto|N")] = "auto",
    allow_outside: bool = False,
) -> None:
    """Cut the object out of photographs without masks.

    Writes them with their alpha, and their cameras, as a new folder to train on: look at its
    masks.html, worst first, and mend what is wrong in any image editor.

    Args:
        data: folder of the photographs and their cameras; masks in it are not looked at
        out: folder to write
        source: where masks come from: rembg, a network on single photographs; a folder of masks
            with the stems of the photographs; or none, the pattern of the ground that the object
            stands on, which it hides. Masks vote for a hull, and those that it contradicts are
            mended
        downscale: write photographs of 1/N of their width and height; auto as of train
        allow_outside: as of train
    """
    from univoxel.tasks import cutout as task

    options = {"downscale": check_downscale(downscale), "allow_outside": allow_outside}
    print(task.cutout(data, out, source, **options))


def poses(
    photographs: Annotated[Positional[Path], arg(metavar="PHOTOS")],
    /,
    out: Annotated[Path, arg(metavar="SCENE")],
    masks: Annotated[
        Path | None, arg(metavar="DIR", help_behavior_hint="(default: the whole pictures)")
    ] = None,
    every: Annotated[
        float | None, arg(metavar="SECONDS", help_behavior_hint="(default: 80 frames in all)")
    ] = None,
    keep_size: Annotated[int, arg(metavar="PIXELS")] = KEEP_SIZE,
    keep_weak: bool = False,
    size: Annotated[int, arg(metavar="PIXELS")] = FEATURE_SIZE,
    features: Annotated[
        int | None, arg(metavar="N", help_behavior_hint="(default: 4096; with --fast: 2048)")
    ] = None,
    fast: bool = False,
    seed: int = 0,
) -> None:
    """Find the cameras of photographs, or of the frames of a video.

    Writes them upright, with their cameras, as a new folder to train on, in COLMAP's layout. The
    same command again goes on after an interruption.

    Args:
        photographs: folder of JPEG, PNG, TIFF, WebP, HEIC or RAW, held either way; or a video
        out: folder to write; its folder sfm/ keeps the steps and is of no use afterwards
        masks: folder with a mask for each photograph, white on the object: features are sought
            within them alone, as a turntable needs it
        every: of a video, the sharpest frame of each so many seconds is taken
        keep_size: most pixels along the longer side of written photographs; 0: as they are
        keep_weak: write photographs too whose cameras may be off by degrees
        size: pixels along the longer side, in which features are sought
        features: most of a photograph
        fast: fewer features, of larger details alone, in a quarter of the time; loses photographs
            of smooth objects
        seed: of all random choices
    """
    from univoxel.capture.config import DEFAULTS, FAST
    from univoxel.tasks import poses as task

    if keep_size < 0:
        raise UserError(f"--keep-size must be at least 0, got {keep_size}")
    if every is not None and not every > 0:
        raise UserError(f"--every must be above 0, got {every:g}")
    config = replace(FAST if fast else DEFAULTS, size=size, seed=seed)
    if features is not None:
        config = replace(config, features=features)
    print(task.poses(photographs, out, masks, every, keep_size, keep_weak, config))


def capture(
    photographs: Annotated[Positional[Path], arg(metavar="PHOTOS")],
    /,
    out: Annotated[Path, arg(metavar="DIR")],
    masks: Annotated[str, arg(metavar="auto|rembg|FOLDER|none")] = "auto",
    preset: PresetOrAuto = "auto",
    light: LightName = "hybrid",
    minutes: Annotated[
        float | None, arg(metavar="MINUTES", help_behavior_hint="(default: none)")
    ] = None,
    set: Changes = (),
    until: Until = "page",
) -> int:
    """From photographs to a mesh with materials and a page, in one command.

    Finds cameras, makes masks, trains, exports DIR/DIR.glb, lights the object anew and writes
    DIR/index.html: poses, cutout, train, export, relight and eval, one after another. What is there
    is not made again: the same command goes on after an interruption.

    Args:
        photographs: what to begin with: a folder of photographs or a video; photographs with
            cameras, as train reads them; or the folder of a trained run
        out: folder to write: scene/, cut/, run/, pictures/, the mesh and the page
        masks: where masks come from: rembg, a network; a folder of masks; none, the pattern of the
            ground, as of cutout; auto takes those that the photographs bring, else the network
        preset: as of train
        light: as of train
        minutes: of training, above 0; as of train
        set: as of train
        until: the last step: page is all of them; cameras or masks end before training, and the
            folder to train on is printed
    """
    from univoxel.tasks import capture as task

    check_minutes(minutes)
    if until != "page":
        if (preset, light, minutes, set) != ("auto", "hybrid", None, ()):
            raise UserError(f"--until {until}: --preset, --light, --minutes, --set come after it")
        print(task.find_data(photographs, out, masks=masks, until=until))
        return 0
    made = task.capture(
        photographs,
        out,
        masks=masks,
        preset=preset,
        minutes=minutes,
        light=light,
        changes=set,
    )
    print(made.page)
    print(made.mesh)
    return code_of(made.run)
