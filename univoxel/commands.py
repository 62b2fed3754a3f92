"""What the command line offers: a function per command, which checks and calls one task.

Tasks are imported by the command that runs them: `univoxel --help` does not wait for torch.
"""

from __future__ import annotations

import contextlib
import math
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import rich
from rich.text import Text
from tyro.conf import Positional, UseAppendAction, arg

from univoxel.errors import ExistingFile, UserError
from univoxel.machine import threads_asked
from univoxel.names import (
    BOUNCES,
    ELEVATION,
    FEATURE_SIZE,
    KEEP_SIZE,
    LIGHTS,
    MAP_ROWS,
    SAMPLES,
    TEXTURE_QUALITY,
    TEXTURE_SIZE,
    USUAL_STEPS,
    Animation,
    Background,
    BatchStep,
    Behind,
    CamerasFrom,
    CapacityOrAuto,
    Differing,
    Downscale,
    FieldName,
    Ground,
    LightFrameOrAuto,
    LightName,
    MasksFrom,
    Metal,
    Origin,
    PresetName,
    PresetOrAuto,
    TextureFormat,
    Until,
)
from univoxel.parsing import Command, Shell

if TYPE_CHECKING:
    from univoxel.config import TrainConfig
    from univoxel.ops import PointLight, Sun

Run: TypeAlias = Annotated[Positional[Path], arg(metavar="RUN")]
AtOnce: TypeAlias = Annotated[int, arg(metavar="N")]
Scheduler: TypeAlias = Annotated[
    str | None, arg(metavar="ADDRESS", help_behavior_hint="(default: this machine)")
]
Scenes: TypeAlias = Annotated[
    Positional[tuple[Path, ...]],
    arg(metavar="SCENE [SCENE ...]", help_behavior_hint="(required)"),
]
Changes: TypeAlias = Annotated[
    UseAppendAction[tuple[str, ...]],
    arg(metavar="FIELD=VALUE", help_behavior_hint="(repeatable)"),
]
Suns: TypeAlias = Annotated[
    UseAppendAction[tuple[tuple[float, ...], ...]],
    arg(metavar="AZIMUTH ELEVATION IRRADIANCE [ANGLE]"),
]
Points: TypeAlias = Annotated[
    UseAppendAction[tuple[tuple[float, float, float, float], ...]],
    arg(metavar="X Y Z INTENSITY"),
]
Minutes: TypeAlias = Annotated[
    float | None, arg(metavar="MINUTES", help_behavior_hint="(default: the preset's)")
]
TimelapseFile: TypeAlias = Annotated[
    str | None, arg(metavar="FILE.gif|FILE.mp4|DIR/", help_behavior_hint="(default: none)")
]
Seed: TypeAlias = Annotated[
    int | None, arg(metavar="N", help_behavior_hint="(default: 0, or that of --config)")
]
ConfigFile: TypeAlias = Annotated[
    Path | None, arg(metavar="FILE", help_behavior_hint="(default: what --preset says)")
]
Megabytes: TypeAlias = Annotated[
    float | None, arg(metavar="MB", help_behavior_hint="(default: no limit)")
]
Host: TypeAlias = Annotated[
    str | None, arg(metavar="ADDRESS", help_behavior_hint="(default: 127.0.0.1)")
]
Port: TypeAlias = Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 8080)")]
JsonFile: TypeAlias = Annotated[
    Path | None, arg(metavar="FILE|-", help_behavior_hint="(default: none)")
]
LightOf: TypeAlias = Annotated[
    str | None, arg(metavar="VIEW", help_behavior_hint="(default: the mean of all)")
]


STDOUT = Path("-")  # as a file for JSON: print it, and it alone


@contextlib.contextmanager
def json_file(asked: Path | None) -> Iterator[Path | None]:
    """The file for a task to write; what was asked to be printed is, at the end."""
    if asked != STDOUT:
        yield asked
        return
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "printed.json"
        yield file
        print(file.read_text(encoding="utf-8"), end="")


def check_minutes(minutes: float | None) -> None:
    """Refuse a limit that is not above 0.

    Raises:
        UserError: it is not.
    """
    if minutes is not None and not minutes > 0:
        raise UserError(f"--minutes must be above 0, got {minutes:g}")


def check_downscale(downscale: Downscale) -> int:
    """The side of the squares of pixels that become one; 0 for auto.

    Raises:
        UserError: it is below 1.
    """
    if downscale == "auto":
        return 0
    if downscale < 1:
        raise UserError(f"--downscale must be at least 1, got {downscale}")
    return downscale


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

    if file is None:
        return choices.configuration(minutes, data, out)
    for field in fields(choices):
        if (value := getattr(choices, field.name)) != field.default:
            option = f"--{field.name.replace('_', '-')} {value}"
            raise UserError(f"expected --config or {option}, got both: {file} says it")
    config = replace(load_config(file), data=data, out=out)
    return config if minutes is None else replace(config, minutes=minutes)


def sun_light(values: tuple[float, ...]) -> Sun:
    """A white sun from azimuth and elevation in degrees, irradiance and, perhaps, its angle.

    Raises:
        UserError: not 3 or 4 numbers, or one out of range.
    """
    from univoxel.ops import Sun

    if len(values) not in (3, 4):
        raise UserError(f"--sun: expected AZIMUTH ELEVATION IRRADIANCE [ANGLE], got {values}")
    azimuth, elevation = (math.radians(x) for x in values[:2])
    across = math.cos(elevation)
    direction = (across * math.cos(azimuth), across * math.sin(azimuth), math.sin(elevation))
    try:
        return Sun(direction, (values[2], values[2], values[2]), *values[3:])
    except ValueError as error:
        raise UserError(f"--{error}") from None


def point_light(values: tuple[float, float, float, float]) -> PointLight:
    """A white point light from x, y, z and its intensity.

    Raises:
        UserError: a number is out of range.
    """
    from univoxel.ops import PointLight

    x, y, z, intensity = values
    try:
        return PointLight((x, y, z), (intensity, intensity, intensity))
    except ValueError as error:
        raise UserError(f"--point: {error}") from None


def parse_ground(text: str | None) -> Ground:
    """A height, the word lowest, or nothing.

    Raises:
        UserError: another text.
    """
    if text is None or text == "lowest":
        return text
    try:
        return float(text)
    except ValueError:
        raise UserError(f"--ground: expected lowest or a height, got {text!r}") from None


def tell_run(run: Path, no_page: bool) -> None:
    """Print where a trained run lies, with its page if it gets one; the first rank does so."""
    from univoxel.ranks import leads
    from univoxel.tasks.view import with_page

    if leads():
        print(run if no_page else with_page(run))


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
) -> None:
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
        minutes: wall-clock limit, above 0; training ends in time with what it has
        capacity: adaptive makes no larger a model than the scene needs, as held-out pixels tell:
            coarser grid, fewer rows or channels of features, fewer lobes and hidden units. auto is
            that, but fixed for sparse fields and for lights other than hybrid
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
    tell_run(task.train(changed(asked, set), resume=resume, **watched), no_page)


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
        preset: as of train; without --minutes on one thread, its training gets twice its time
        light: as of train
        minutes: wall-clock limit of each training, above 0
        config: as of train
        set: as of train
        masks: as of capture, for the step masks
        samples: of the light, per pixel of relit pictures that are measured
        tries: how often a scene whose process is killed is tried before it counts as failed
        json: another file for what batch.json holds; - prints it in place of the table
    """
    from univoxel.batch.scenes import Wanted
    from univoxel.tasks import batch as task

    check_minutes(minutes)
    wanted = Wanted(steps, masks, preset, light, minutes, config, set, samples)
    options = {"jobs": jobs, "threads": threads_asked(), "scheduler": scheduler, "tries": tries}
    with json_file(json) as file:
        results = task.batch(scenes, out, wanted, **options, json=file)
    if json != STDOUT:
        rich.print(task.table(results))
        print(out / "index.html")
    task.check(results)


def cutout(
    data: Annotated[Positional[Path], arg(metavar="DATA")],
    /,
    out: Annotated[Path, arg(metavar="DIR")],
    source: Annotated[
        str, arg(name="from", metavar="rembg|FOLDER|none", help_behavior_hint="(default: none)")
    ] = "none",
    box: Annotated[
        tuple[float, float, float, float, float, float] | None,
        arg(metavar="X Y Z X Y Z", help_behavior_hint="(default: around what cameras look at)"),
    ] = None,
    downscale: Annotated[Downscale, arg(metavar="auto|N")] = "auto",
    allow_outside: bool = False,
    seed: int = 0,
) -> None:
    """Cut the object out of photographs without masks.

    Writes them with their alpha, and their cameras, as a new folder to train on: look at its
    masks.html, worst first, and mend what is wrong in any image editor.

    Args:
        data: folder of the photographs and their cameras; masks in it are not looked at
        out: folder to write
        source: where masks come from: rembg, a network on single photographs; a folder of masks
            with the stems of the photographs; or none, colours alone. Masks vote for a hull, and
            those that it contradicts are mended
        box: with colours alone: lower and upper corner of where the object is, in the world of the
            cameras; what lies in it, such as a table, is part of the object
        downscale: write photographs of 1/N of their width and height; auto as of train
        allow_outside: as of train
        seed: of all random choices
    """
    from univoxel.tasks import cutout as task

    options = {"downscale": check_downscale(downscale), "allow_outside": allow_outside}
    options["seed"] = seed
    print(task.cutout(data, out, source, box=box, **options))


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
        float | None, arg(metavar="MINUTES", help_behavior_hint="(default: the preset's)")
    ] = None,
    set: Changes = (),
    until: Until = "page",
) -> None:
    """From photographs to a mesh with materials and a page, in one command.

    Finds cameras, makes masks, trains, exports DIR/DIR.glb, lights the object anew and writes
    DIR/index.html: poses, cutout, train, export, relight and eval, one after another. What is there
    is not made again: the same command goes on after an interruption.

    Args:
        photographs: what to begin with: a folder of photographs or a video; photographs with
            cameras, as train reads them; or the folder of a trained run
        out: folder to write: scene/, cut/, run/, pictures/, the mesh and the page
        masks: where masks come from: rembg, a network; a folder of masks; none, colours alone; auto
            takes those that the photographs bring, else the network, if it is installed, else
            colours
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
        return
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


def evaluate(
    run: Run,
    /,
    data: Annotated[
        Path | None, arg(metavar="DATA", help_behavior_hint="(default: the data trained on)")
    ] = None,
    save: Annotated[
        Path | None, arg(metavar="DIR", help_behavior_hint="(default: none are written)")
    ] = None,
    json: JsonFile = None,
    samples: int = SAMPLES,
    bounces: int = BOUNCES,
    light_of: LightOf = None,
    test_every: Annotated[
        int | None, arg(metavar="N", help_behavior_hint="(default: the test split)")
    ] = None,
    background: Behind = "black",
    fit_light: bool = False,
) -> None:
    """Measure a run on the test views and print the table.

    Args:
        run: folder of a trained run
        data: folder of the photographs
        save: folder for the rendered pictures
        json: file for the measures; - prints them in place of the table
        samples: of the light, per pixel of relit pictures
        bounces: reflections between parts of the object in relit pictures, 0 for none
        light_of: training view, by name or number, in whose light novel views are rendered, where
            the run was trained with --varying
        test_every: measure the first of every so many photographs, in order of all names; none of
            them may have been trained on
        background: what novel views are composited on
        fit_light: render each novel view in the light in which it looks most like its photograph,
            as the field does where light differs from photograph to photograph
    """
    from univoxel.tasks import evaluate as task

    with json_file(json) as file:
        measures = task.evaluate(
            run,
            data=data,
            save=save,
            json=file,
            samples=samples,
            bounces=bounces,
            light_of=light_of,
            test_every=test_every,
            background=background,
            fit_light=fit_light,
        )
    if json != STDOUT:
        rich.print(task.table(measures))


def relight(
    run: Run,
    /,
    envmap: Annotated[
        tuple[Path, ...],
        arg(metavar="MAP [MAP ...]", help_behavior_hint="(default: none)"),
    ] = (),
    sun: Suns = (),
    point: Points = (),
    out: Annotated[
        Path | None, arg(metavar="DIR", help_behavior_hint="(default: in RUN/relight)")
    ] = None,
    cameras: Annotated[str, arg(metavar="test|orbit|FILE")] = "test",
    orbit: Annotated[int | None, arg(metavar="FRAMES")] = None,
    elevation: Annotated[float, arg(metavar="DEGREES")] = ELEVATION,
    turn: Annotated[int | None, arg(metavar="FRAMES")] = None,
    resolution: Annotated[
        int | None, arg(metavar="PIXELS", help_behavior_hint="(default: the data's; orbits: 512)")
    ] = None,
    rotate: Annotated[float, arg(metavar="DEGREES")] = 0.0,
    exposure: Annotated[float, arg(metavar="FACTOR")] = 1.0,
    samples: int = SAMPLES,
    noise: Annotated[float | None, arg(metavar="SHARE")] = None,
    bounces: int = BOUNCES,
    background: Background = "transparent",
    ground: Annotated[str | None, arg(metavar="lowest|HEIGHT")] = None,
    animation: Annotated[tuple[Animation, ...], arg(help_behavior_hint="(default: none)")] = (),
    resume: bool = False,
) -> None:
    """Render a run under other light: environment maps, suns, points.

    Args:
        run: folder of a trained run
        envmap: equirectangular maps, twice as wide as high, .exr or .hdr, linear radiance
        sun: a far light: degrees from +X counter-clockwise and above the horizon, irradiance,
            degrees across (0.53 if not given; 0: hard shadows); repeatable
        point: a near light: where it stands, irradiance at distance 1; repeatable
        out: folder for the pictures, with a folder for each map where there are several
        cameras: the test views, an orbit around the object, or a path in a transforms.json
        orbit: frames of an orbit; the same as --cameras "orbit FRAMES"
        elevation: of an orbit above the horizon, degrees
        turn: frames of a turn of the light under the first camera
        resolution: width of the pictures
        rotate: turn maps and suns counter-clockwise about +Z, degrees
        exposure: factor on all light
        samples: of the light, per pixel
        noise: instead of --samples: as many as bring the relative noise below this, such as 0.02
        bounces: reflections between parts of the object
        background: what stands behind the object
        ground: z of a floor that catches the object's shadow, or lowest for its lowest point
        animation: the frames as a moving picture too
        resume: keep the frames that are there
    """
    from univoxel.tasks import relight as task

    if orbit is not None and cameras != "test":
        raise UserError(f"expected --orbit or --cameras, got {orbit} and {cameras}")
    if out is None:
        out = run / "relight" / envmap[0].stem if len(envmap) == 1 else run / "relight"
    task.relight_to_files(
        run,
        envmap[0] if len(envmap) == 1 else envmap,
        out,
        animation=animation,
        resume=resume,
        suns=[sun_light(values) for values in sun],
        point_lights=[point_light(values) for values in point],
        cameras=cameras if orbit is None else f"orbit {orbit}",
        elevation=elevation,
        turn=turn,
        resolution=resolution,
        rotate=rotate,
        exposure=exposure,
        samples=samples,
        noise=noise,
        bounces=bounces,
        background=background,
        ground=parse_ground(ground),
    )
    print(out)


def export(
    run: Run,
    /,
    mesh: Annotated[Path, arg(metavar="FILE.glb|usdz|obj|ply")],
    faces: Annotated[
        int | None,
        arg(metavar="N", help_behavior_hint="(default: 20000 with textures, all without)"),
    ] = None,
    texture_size: Annotated[int, arg(metavar="TEXELS")] = TEXTURE_SIZE,
    watertight: bool = False,
    texture_format: TextureFormat = "png",
    quality: Annotated[int, arg(metavar="1-95")] = TEXTURE_QUALITY,
    size: Annotated[
        float | None, arg(metavar="METRES", help_behavior_hint="(default: as photographed)")
    ] = None,
    origin: Origin = "world",
    lods: Annotated[int, arg(metavar="N")] = 0,
) -> None:
    """Write the surface as a mesh with its materials, for any renderer.

    Args:
        run: folder of a trained run
        mesh: the file to write: .glb, .usdz and .obj hold textures, .ply materials at the vertices
        faces: most triangles, at least 4
        texture_size: width of the square textures, a power of 2 up to 4096
        watertight: close holes, or fail
        texture_format: png loses nothing, jpeg is smaller
        quality: of textures as jpeg
        size: what the longest side of the object becomes
        origin: what lies at 0: the origin of the data set, the middle of the object's floor, or its
            centre
        lods: coarser levels of detail to write beside, FILE_lod1 and so on: each has a quarter of
            the triangles, and textures of half the width
    """
    from univoxel.tasks import export as task

    for path in task.export(
        run,
        mesh,
        faces=faces,
        texture_size=texture_size,
        watertight=watertight,
        texture_format=texture_format,
        quality=quality,
        size=size,
        origin=origin,
        lods=lods,
    ):
        print(path)


def view(
    run: Run,
    /,
    html: Annotated[
        Path | None, arg(metavar="FILE.html", help_behavior_hint="(default: a server)")
    ] = None,
    envmap: Annotated[
        tuple[Path, ...],
        arg(metavar="MAP [MAP ...]", help_behavior_hint="(default: the usual ones alone)"),
    ] = (),
    title: Annotated[
        str | None, arg(metavar="TEXT", help_behavior_hint="(default: the folder's name)")
    ] = None,
    host: Annotated[str, arg(metavar="ADDRESS")] = "127.0.0.1",
    port: Annotated[int, arg(metavar="N")] = 8080,
) -> None:
    """Look at a run in a browser and turn its light; or write it as one web page to send.

    Args:
        run: folder of a trained run
        html: write this page, which needs no network, instead of serving
        envmap: equirectangular maps to offer, before the usual ones
        title: what stands above the object
        host: address to listen on; the default is reached from this machine alone
        port: port to listen on; 0 is any free one
    """
    from univoxel.tasks import view as task

    page = task.view(run, html, envmap=envmap, title=title, host=host, port=port)
    if page is not None:
        print(page)


def envmap(
    run: Run,
    /,
    out: Annotated[Path, arg(metavar="FILE.exr|hdr")],
    height: Annotated[int, arg(metavar="ROWS")] = MAP_ROWS,
    light_of: LightOf = None,
) -> None:
    """Write the light of the photographs as an environment map.

    Args:
        run: folder of a trained run
        out: the map, linear radiance, in 32 bits a channel as .exr, a pixel as .hdr; a picture of
            it goes beside, with the true map if the data set has it
        height: rows of the map; it is twice as wide
        light_of: training view, by name or number, whose map it is, where the run was trained with
            --varying
    """
    from univoxel.tasks import envmap as task

    found = task.envmap(run, out, height=height, light_of=light_of)
    print(out)
    if found:
        print(f"grey ball under it: PSNR {found.ball_psnr:.1f} dB, a scale per channel")
        print(f"mirror ball under it: PSNR {found.mirror_psnr:.1f} dB")
        print(f"brightest directions: {found.brightest_degrees:.1f} degrees apart")


def report(
    run: Run,
    /,
    html: Annotated[
        Path | None, arg(metavar="FILE.html", help_behavior_hint="(default: RUN/report.html)")
    ] = None,
    data: Annotated[
        Path | None, arg(metavar="DATA", help_behavior_hint="(default: the data trained on)")
    ] = None,
    views: Annotated[int, arg(metavar="N")] = 4,
    title: Annotated[
        str | None, arg(metavar="TEXT", help_behavior_hint="(default: the folder's name)")
    ] = None,
) -> None:
    """Say how good a run is, and what to photograph next, on one web page.

    Photographs beside their render, doubt painted on the object, materials, light, the course of
    training, and directions from which more photographs would help. It needs no truth.

    Args:
        run: folder of a trained run
        html: the page to write, which needs no network
        data: folder of the photographs, where they were moved
        views: photographs beside their render, the worst first
        title: what stands above it
    """
    from univoxel.tasks import report as task

    print(task.report(run, html, data=data, views=views, title=title))


def submit(
    run: Run,
    /,
    out: Annotated[Path, arg(metavar="DIR")],
    samples: Annotated[int, arg(metavar="N")] = SAMPLES,
    bounces: Annotated[int, arg(metavar="N")] = BOUNCES,
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
    from univoxel.tasks import submit as task

    print(task.submit(run, out, samples, bounces))


def inspect(
    run: Run,
    /,
    view: Annotated[str, arg(metavar="VIEW")],
    pixel: Annotated[str, arg(metavar="COLUMN,ROW")],
    out: Annotated[
        Path | None,
        arg(metavar="FILE.png", help_behavior_hint="(default: in RUN/inspect)"),
    ] = None,
    light_of: LightOf = None,
) -> None:
    """Draw the light that falls on one point of the surface.

    The truth stands beside it where it is known.

    Args:
        run: folder of a trained run
        view: name or number of a test view
        pixel: whose surface point; 0,0 is the top left
        out: the picture; an .exr file with the layers goes beside
        light_of: training view, by name or number, whose light it is, where the run was trained
            with --varying
    """
    from univoxel.tasks import inspect as task

    print(task.inspect(run, view, task.parse_pixel(pixel), out, light_of=light_of))


def info(
    run: Run,
    /,
    json: JsonFile = None,
    picture: Annotated[
        Path | None, arg(metavar="FILE.png", help_behavior_hint="(default: none)")
    ] = None,
) -> None:
    """Say what a model consists of, and what was chosen for it.

    Parameters and bytes by part, and sizes. Also whether points that are matched between the
    photographs lie where the cameras put them.

    Args:
        run: folder of a trained run
        json: file for the numbers; - prints them in place of tables
        picture: where the grid's nodes are that hold features, and a bar of bytes by part
    """
    from univoxel.tasks import info as task

    with json_file(json) as file:
        found = task.info(run, json=file, picture=picture)
    if json == STDOUT:
        return
    for table in task.tables(found):
        rich.print(table)
    for choice in found["chosen"]:
        rich.print(Text(choice["said"]))


def compare(
    scenes: Scenes,
    /,
    out: Annotated[Path, arg(metavar="DIR")],
    preset: PresetOrAuto = "auto",
    light: Annotated[tuple[str, ...], arg(metavar="LIGHT [LIGHT ...]")] = LIGHTS,
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
    from univoxel.experiments import compare as experiment

    check_minutes(minutes)
    where = {"jobs": jobs, "scheduler": scheduler}
    print(experiment.compare(scenes, out, preset, light, minutes, set, samples, **where))


def chart(
    scenes: Scenes,
    /,
    out: Annotated[Path, arg(metavar="DIR")],
    preset: PresetName = "fast",
    light: LightName = "hybrid",
    quick: bool = False,
    only: Annotated[
        tuple[str, ...], arg(metavar="SETTING [SETTING ...]", help_behavior_hint="(default: all)")
    ] = (),
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
    from univoxel.experiments import chart as experiment

    where = {"jobs": jobs, "scheduler": scheduler}
    print(experiment.chart(scenes, out, preset, light, quick, only, set, samples, **where))


def stress(
    out: Annotated[Path, arg(metavar="DIR")],
    quick: bool = False,
    only: Annotated[
        tuple[str, ...], arg(metavar="AXIS [AXIS ...]", help_behavior_hint="(default: all)")
    ] = (),
    light: Annotated[
        tuple[str, ...],
        arg(
            metavar="LIGHT [LIGHT ...]",
            help_behavior_hint="(default: sg sh envmap hybrid; with --quick: hybrid)",
        ),
    ] = (),
    seeds: Annotated[
        int | None, arg(metavar="N", help_behavior_hint="(default: 3; with --quick: 1)")
    ] = None,
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
    from univoxel.experiments.stress import suite

    where = {"jobs": jobs, "scheduler": scheduler}
    print(suite.stress(out, only, light, seeds, quick, set, **where))


def demo(out: Annotated[Path, arg(metavar="DIR")] = Path("univoxel-demo")) -> None:
    """Train, evaluate and relight the bundled scene, in minutes.

    Args:
        out: folder for everything it writes; the page to open is DIR/index.html
    """
    from univoxel.tasks import demo as task

    print(task.demo(out))


def doctor(
    json: JsonFile = None,
) -> None:
    """Look at this installation and machine, and say what they lack.

    Processor and the kernels built for it, Embree, torch, OpenMP, threads, memory, extras. Ends
    with exit code 2 where training would be refused.

    Args:
        json: file for the findings; - prints them in place of the table
    """
    from univoxel.tasks import doctor as task

    with json_file(json) as file:
        findings = task.doctor(json=file)
    if json != STDOUT:
        rich.print(task.table(findings))
    task.check(findings)


def completion(shell: Annotated[Positional[Shell], arg(metavar="bash|zsh|fish")], /) -> None:
    """Print what makes a shell complete commands, options and choices.

    For bash, in ~/.bashrc: eval "$(univoxel completion bash)"

    Args:
        shell: that reads it
    """
    from univoxel import parsing

    print(parsing.completion(shell, EVERYDAY, LABORATORY), end="")


COMMANDS: dict[str, Command] = {
    "capture": capture,
    "poses": poses,
    "cutout": cutout,
    "train": train,
    "batch": batch,
    "eval": evaluate,
    "relight": relight,
    "export": export,
    "view": view,
    "report": report,
    "envmap": envmap,
    "inspect": inspect,
    "info": info,
    "submit": submit,
    "compare": compare,
    "chart": chart,
    "stress": stress,
    "demo": demo,
    "doctor": doctor,
    "completion": completion,
}

# Written `univoxel lab NAME`; without the word, as they once were, they work too
LABORATORY = {name: COMMANDS[name] for name in ("compare", "chart", "stress", "submit")}
EVERYDAY = {name: command for name, command in COMMANDS.items() if name not in LABORATORY}
