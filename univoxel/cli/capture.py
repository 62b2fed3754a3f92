"""From photographs to a relightable object in one command: cameras, masks, training, mesh."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from univoxel.capture.config import DEFAULTS, CaptureConfig
from univoxel.cli.demo import MAPS, SCENE
from univoxel.cli.evaluate import evaluate
from univoxel.cli.export import export
from univoxel.cli.parsing import ADVANCED, BoxOf, Changes, Minutes, check_minutes, takes, written
from univoxel.cli.relight import relight_to_files
from univoxel.cli.train import code_of
from univoxel.core import choices, files, log
from univoxel.core.files import read_json, replacing
from univoxel.core.progress_bar import duration
from univoxel.core.validation import check_settings, setting
from univoxel.errors import (
    DataError,
    ExistingFile,
    MissingExtra,
    StillBackground,
    UserError,
    WithoutMasks,
)

if TYPE_CHECKING:
    from univoxel.capture.project import Given, Project
    from univoxel.config import TrainConfig
    from univoxel.training.progress import TrainingProgress


AUTO = "auto"  # masks that the photographs have, or else of a network, or of depth only
STEPS = ("cameras", "masks", "training", "mesh", "pictures", "page")


@dataclass(frozen=True)
class CaptureOptions:
    photographs: Annotated[Path, written("PHOTOS", positional=True)]
    """folder of photographs, a video, a data set with cameras, or a trained run"""
    out: Annotated[Path, written("DIR")]
    """output folder, for scene/, cut/, run/, pictures/, the mesh and the page"""
    masks: Annotated[str, written("auto|rembg|FOLDER|none")] = AUTO
    """source of the masks; auto: masks in PHOTOS, else a network, else depth maps"""
    network: Annotated[choices.NetworkName, ADVANCED] = choices.NETWORK
    """network that makes the masks; those listed later are slower but more accurate"""
    box: BoxOf = None
    """corners of a box around the object, in world coordinates of DIR/scene"""
    keep_table: Annotated[bool, ADVANCED] = False
    """keep the part of the table that is inside the box; needs --masks none"""
    preset: choices.PresetOrAuto = "auto"
    """amount of work, from draft to best; auto: what fits in --minutes, else fast"""
    light: Annotated[choices.LightName, ADVANCED] = "hybrid"
    """lighting model; hybrid keeps shadows out of the albedo; the others are baselines"""
    minutes: Minutes = None
    """time limit for training; finding cameras and making masks takes extra time"""
    changes: Changes = ()
    """change one configuration field, such as loss.radiance=0.5; repeatable"""
    until: choices.Until = "page"
    """last step to run; cameras and masks end before training and print their folder"""

    @property
    def fingerprint(self) -> Any:
        """What steps.json has of the masks: a word, unless more was chosen."""
        chosen: dict[str, Any] = {}
        if self.network != choices.NETWORK:
            chosen["network"] = self.network
        if self.box is not None:
            chosen["box"] = [float(value) for value in self.box]
        if self.keep_table:
            chosen["keep_table"] = True
        return {"masks": str(self.masks), **chosen} if chosen else str(self.masks)


@takes(CaptureOptions)
def command(asked: CaptureOptions) -> int:
    """Turn photographs into a relightable object, in one command.

    Runs poses, cutout, train, export, relight and eval, and writes a mesh, DIR/DIR.glb, and a web
    page, DIR/index.html. Finished steps are kept: after an interruption, run the same command again
    to resume.
    """
    from univoxel.run import load_verdict

    check_minutes(asked.minutes)
    if asked.until == "page":
        made = capture(**vars(asked))
        if verdict := load_verdict(made.run):
            log.info("\n".join(verdict.lines()))
        print(made.page)
        print(made.mesh)
        return code_of(made.run)
    if (asked.preset, asked.light, asked.minutes, asked.changes) != ("auto", "hybrid", None, ()):
        raise UserError(
            f"--until {asked.until} does not train: leave out --preset, --light, --minutes and "
            "--set"
        )
    print(find_data(**vars(asked)))
    return 0


@dataclass(frozen=True)
class PicturesConfig:
    """The pictures of a capture."""

    frames: int = setting(8, "number of frames of the orbit under each environment map", least=1)
    resolution: int = setting(512, "width and height of the images", unit="pixels", least=1)
    samples: int = setting(choices.SAMPLES, "light samples per pixel", least=1)

    __post_init__ = check_settings


PICTURES = PicturesConfig()


@dataclass(frozen=True)
class Captured:
    """The results of a capture: the page and files to open."""

    page: Path
    mesh: Path  # .glb
    run: Path  # for `univoxel.open_run`


def capture(
    photographs: str | Path,
    out: str | Path,
    *,
    on_progress: Callable[[TrainingProgress], None] | None = None,
    config: CaptureConfig = DEFAULTS,
    pictures: PicturesConfig = PICTURES,
    **options: Any,
) -> Captured:
    """Turn photographs into a relightable object, in steps whose results are kept.

    The folder `out` gets scene/ (photographs and cameras), cut/ (the same with masks), run/ (the
    trained run), pictures/ (the object under new light, and metrics), the mesh and index.html.
    Finished steps are kept: after an interruption, call the function again to resume. If you
    already have cameras, masks or a run, the steps that make them are skipped.

    Args:
        photographs: a folder of photographs or a video; or photographs with cameras, in any layout
            that `train` reads; or a trained run.
        out: folder to write to.
        on_progress: as in `univoxel.train`.
        config: how cameras are found.
        pictures: number and size of the images.
        options: fields of `univoxel.cli.capture.CaptureOptions`, such as masks, box, preset and
            minutes; until must be page: for the first steps only, call `find_data`.

    Raises:
        ExistingFile: out holds another capture, or results of other options.
        MissingExtra: a package that finds cameras, reads a format or makes masks is missing.
        MissingNative: the compiled extension is missing or was built without Embree.
        DataError: photographs, cameras or masks cannot be used.
        UserError: an argument cannot be used, or there is no surface.
        ProcessFailed: the search for cameras failed.
        Cancelled: on_progress raised it.
        OSError: a file cannot be written.
    """
    from univoxel.capture.project import Project, begin, look_at
    from univoxel.core.validation import changed
    from univoxel.presets import chosen
    from univoxel.scene import FILE
    from univoxel.training.clock import expected_seconds
    from univoxel.training.probe import slowdown

    asked = CaptureOptions(Path(photographs), Path(out), **options)
    if asked.until != "page":
        raise UserError(
            f"until must be page, got {asked.until}: to stop earlier, call `find_data`", "until"
        )
    given, project = look_at(asked.photographs), Project(asked.out)
    training = chosen(asked.preset, asked.minutes, project.cut, project.run, asked.light)
    training = changed(training, asked.changes)
    if given.kind == "run":
        _check_unused(given, asked, training)
    _check_machine(given, asked)
    begin(project, given)
    _check_network(project, asked)
    if given.kind == "run":
        run = given.path
        for step in STEPS[:3]:
            _skip(step, run)
    else:
        if not (project.run / FILE).exists():
            seconds = slowdown(training) * sum(map(expected_seconds, training.stages))
            said = f"training takes about {duration(seconds)} on this machine"
            log.info(f"{said}, after cameras are found and masks are made")
        scene = _find_cameras(project, given, asked, config)
        data = _find_masks(project, scene, asked)
        run = _train(replace(training, data=data.absolute(), out=project.run), on_progress)
    if _up_to_date(project.mesh, run):
        _skip("mesh", project.mesh)
    else:
        _say("mesh", str(project.mesh))
        export(run, project.mesh)
    _picture(project, run, pictures)
    _say("page", str(project.page))
    _write_page(project, given, run)
    return Captured(project.page, project.mesh, run)


def find_data(
    photographs: str | Path, out: str | Path, config: CaptureConfig = DEFAULTS, **options: Any
) -> Path:
    """Run the first steps of a capture, which `capture` can resume; return the folder to train on.

    Args:
        options: fields of `CaptureOptions`; until is cameras, or else masks.

    Raises:
        UserError: photographs are a trained run; otherwise as in `capture`.
        OSError: a file cannot be written.
    """
    from univoxel.capture.project import Project, begin, look_at

    asked = CaptureOptions(Path(photographs), Path(out), **options)
    given, project = look_at(asked.photographs), Project(asked.out)
    if given.kind == "run":
        raise UserError(f"{given.path} is a trained run, so until must be page", "until")
    _check_machine(given, asked)
    begin(project, given)
    _check_network(project, asked)
    scene = _find_cameras(project, given, asked, config)
    return scene if asked.until == "cameras" else _find_masks(project, scene, asked)


def _say(step: str, what: str) -> None:
    log.info(f"step {STEPS.index(step) + 1} of {len(STEPS)}, {step}: {what}")


def _skip(step: str, what: Path) -> None:
    _say(step, f"already done, see {what}")


def _check_unused(given: Given, asked: CaptureOptions, training: TrainConfig) -> None:
    """Refuse options of steps that a run has behind it."""
    from univoxel.presets import chosen

    usual = chosen("auto", None, training.data, training.out)
    if asked.fingerprint != AUTO or training != usual:
        raise UserError(
            f"{given.path} is a trained run: leave out masks, network, box, preset, minutes, "
            "light and set, which would have no effect",
            *("masks", "network", "box", "preset", "minutes", "light", "set"),
        )


def _check_machine(given: Given, asked: CaptureOptions) -> None:
    """Refuse now what would fail after minutes."""
    from univoxel.capture.cutout import check_masks
    from univoxel.capture.masks import mask_network
    from univoxel.capture.sfm import require_pycolmap
    from univoxel.ops import native

    if not native.reference_asked():
        native.require_embree("capture")
    if given.kind == "photographs":
        require_pycolmap()
    masks = str(asked.masks)
    check_masks(masks, asked.network, asked.box, asked.keep_table)
    if masks == choices.REMBG:
        mask_network(asked.network)
    elif masks not in (AUTO, choices.DEPTH) and not Path(masks).is_dir():
        raise DataError(
            f"masks: expected {choices.REMBG}, {choices.DEPTH} or a folder of masks, got {masks}",
            "masks",
        )


def _check_network(project: Project, asked: CaptureOptions) -> None:
    """Refuse to continue with masks of single photographs that another network made."""
    from univoxel.capture.project import SINGLE

    def other(before: str) -> ExistingFile:
        return ExistingFile(
            f"{project.out} contains cameras that were found with masks from network={before}: "
            "pass that network, or choose another folder for out",
            *("network", "out"),
        )

    if str(asked.masks) not in (AUTO, choices.REMBG):
        return
    if not files.done(project.out, SINGLE, asked.network, other):
        before = choices.NETWORK  # which versions without a choice had, and did not note
        if project.masks.exists() and asked.network != before:
            raise other(before)


def _find_cameras(
    project: Project, given: Given, asked: CaptureOptions, config: CaptureConfig
) -> Path:
    """The folder of photographs with cameras."""
    from univoxel.capture.poses import poses
    from univoxel.capture.project import TURNED
    from univoxel.capture.scene import REPORT

    done = given.path if given.kind == "scene" else project.scene
    if given.kind == "scene" or (done / REPORT).exists():
        _skip("cameras", done)
        return done
    if not files.recorded(project.out, TURNED):
        _say("cameras", f"from {given.path}")
        try:
            return poses(given.path, done, config=config)
        except StillBackground as error:
            log.info(f"{error.seen}, as on a turntable, so masks are made before cameras are found")
            files.finish(project.out, TURNED, True)
    first = _masks_before_cameras(project, given, asked)
    _say("cameras", f"found from the masked parts of {given.path}")
    return poses(given.path, done, masks=first, config=config)


def _masks_before_cameras(project: Project, given: Given, asked: CaptureOptions) -> Path:
    """A folder of masks of single photographs."""
    import numpy as np
    import torch
    from PIL import Image

    from univoxel.capture.masks import mask_network, timed
    from univoxel.capture.photographs import read_upright, require_readers
    from univoxel.capture.poses import folders_of, photographs_of
    from univoxel.capture.project import SINGLE
    from univoxel.core.progress_bar import track

    masks = str(asked.masks)
    if masks not in (AUTO, choices.REMBG, choices.DEPTH):
        return Path(masks)
    if project.masks.exists():
        _skip("masks", project.masks)
        return project.masks
    if masks == choices.DEPTH:
        raise UserError(
            f"{given.path}: the background is static, as on a turntable, so masks are needed to "
            f"find cameras: expected masks={choices.REMBG} or a folder of masks, got {masks}",
            "masks",
        )
    _say("masks", "made by a network, for each photograph")
    masked = mask_network(asked.network)
    pictures, _, _ = photographs_of(given.path, folders_of(project.scene))
    require_readers(pictures)
    files.finish(project.out, SINGLE, asked.network)
    # Nothing half-made goes by its name
    partial = project.masks.with_name(f".{project.masks.name}.partial")
    partial.mkdir(exist_ok=True)
    paths = {file: partial / f"{file.stem}.png" for file in pictures}
    missing = [file for file, path in paths.items() if not path.exists()]
    masked = timed(masked, asked.network, len(missing))
    for file in track(missing, "masks"):
        try:
            picture = read_upright(file, choices.KEEP_SIZE).convert("RGB")
        except DataError:  # which `poses` counts and names
            continue
        mask = (255 * masked(torch.from_numpy(np.array(picture)))).round().byte()
        with replacing(paths[file]) as temporary:
            Image.fromarray(mask.numpy()).save(temporary, format="PNG")
    partial.rename(project.masks)
    return project.masks


def _find_masks(project: Project, scene: Path, asked: CaptureOptions) -> Path:
    """The folder of photographs with masks and cameras."""
    from univoxel.capture.cutout import cutout
    from univoxel.capture.project import MASKS, TURNED

    masks, noted = str(asked.masks), asked.fingerprint

    def other(before: str | dict[str, Any]) -> ExistingFile:
        made = before if isinstance(before, dict) else {"masks": before}
        made = {k: " ".join(map(str, v)) if k == "box" else v for k, v in made.items()}
        words = ", ".join(f"{name}={value}" for name, value in made.items())
        return ExistingFile(
            f"{project.cut} was made with {words}: to make the masks again, remove this folder and "
            f"{project.run}",
            *made,
        )

    if project.cut.exists():
        files.done(project.out, MASKS, noted, other)
        _skip("masks", project.cut)
        return project.cut
    turned = bool(files.recorded(project.out, TURNED))
    if masks == AUTO and not turned and _have_masks(project, scene):
        if asked.box is not None:
            raise UserError(
                f"{scene} already has masks, so a box would have no effect. To make masks inside "
                f"the box, pass masks={choices.REMBG}, masks={choices.DEPTH} or a folder of masks",
                "masks",
            )
        _skip("masks", scene)
        return scene
    files.finish(project.out, MASKS, noted)  # before: the folder appears whole, at the end
    if turned:
        source = scene / "masks"  # those that the cameras were found with
    else:
        source = _network_or_depth(asked.network) if masks == AUTO else asked.masks
    words = {choices.REMBG: "from a network", choices.DEPTH: "from depth maps"}
    _say("masks", words.get(str(source), f"from {source}"))
    return cutout(
        *(scene, project.cut, source),
        network=asked.network if source == choices.REMBG else choices.NETWORK,
        box=asked.box,
        keep_table=asked.keep_table,
    )


def _network_or_depth(name: choices.NetworkName) -> str:
    """Where masks come from that nobody has: a network, if one is installed."""
    from univoxel.capture.masks import mask_network

    try:
        mask_network(name)
    except MissingExtra as missing:
        if name != choices.NETWORK:  # which nobody names for nothing
            raise
        log.info(f"no mask network is installed, so masks are made from depth maps ({missing})")
        return choices.DEPTH
    return choices.REMBG


def _have_masks(project: Project, scene: Path) -> bool:
    """Whether photographs bring masks."""
    from univoxel.data import keep_photos, load_photos
    from univoxel.run import kept_photos, trained_on

    if (project.run / "config.json").is_file():  # without reading them
        return trained_on(project.run) == scene.absolute()
    kept = kept_photos(project.run, "train")
    try:
        photos = load_photos(scene, "train", kept=kept)
    except WithoutMasks:
        return False
    kept.parent.mkdir(exist_ok=True)
    keep_photos(photos, kept)  # training need not read them again
    return True


def _train(wanted: TrainConfig, on_progress: Callable[[TrainingProgress], None] | None) -> Path:
    """The folder of the run, trained to its end."""
    from univoxel.cli.trainer import train
    from univoxel.scene import FILE

    run, data = wanted.out, wanted.data
    done, begun = (run / "trust.txt").exists(), (run / FILE).exists()
    if done or begun:
        _check_trained(wanted, done)
    if not done:
        _say("training", "resumed" if begun else f"on {data}")
        return train(wanted, resume=begun, on_progress=on_progress)
    _skip("training", run)
    newest = max((p.stat().st_mtime_ns for p in data.rglob("*.png")), default=0)
    if newest > (run / FILE).stat().st_mtime_ns:
        log.warning(f"{data} has changed since training: to train again, remove {run}")
    return run


def _check_trained(wanted: TrainConfig, done: bool) -> None:
    """Refuse a run that other options began."""
    from univoxel.config import check_same

    try:
        before = read_json(wanted.out / "config.json")
        check_same(replace(wanted, downscale=before["downscale"]))
        same = not done or before["minutes"] == wanted.minutes
    except (UserError, OSError, KeyError, TypeError):
        same = False
    if not same:
        raise ExistingFile(
            f"{wanted.out} was trained with other values of preset, minutes, light or set: to "
            "train again, remove that folder or choose another folder for out",
            *("preset", "minutes", "light", "set", "out"),
        )


def _up_to_date(file: Path, run: Path) -> bool:
    """Whether a file was made since the run was trained."""
    from univoxel.scene import FILE

    return file.exists() and file.stat().st_mtime_ns >= (run / FILE).stat().st_mtime_ns


def _picture(project: Project, run: Path, config: PicturesConfig) -> None:
    """Write the object under other light, and measures; what is there of this run stays."""
    from univoxel.capture.project import discard_older
    from univoxel.scene import FILE

    folder = project.pictures
    measures = folder / "measures.json"
    if _up_to_date(measures, run):
        return _skip("pictures", folder)
    _say("pictures", str(folder))
    discard_older(folder, than=run / FILE)
    relight_to_files(
        run,
        [SCENE / "envmaps" / f"{name}.hdr" for name in MAPS],
        folder,
        resume=True,
        cameras=f"orbit {config.frames}",
        resolution=config.resolution,
        samples=config.samples,
    )
    try:
        evaluate(run, save=folder / "test", json=measures)
    except DataError as error:  # such as a run whose photographs are elsewhere now
        log.warning(f"metrics are missing: {error}")
    return None


def _write_page(project: Project, given: Given, run: Path) -> None:
    """Write the page of the object, which also says what is beside it."""
    from univoxel.detail.texture import page_options
    from univoxel.evaluation.measures import in_words
    from univoxel.output.page import write_page

    beside = [
        ("the mesh with materials", project.mesh),
        ("rendered images with their layers", project.pictures),
        ("the masks, with the worst first", project.cut / "masks.html"),
    ]
    named = [
        f"{what} ({path.relative_to(project.out).as_posix()})"
        for what, path in beside
        if path.exists()
    ]
    measures = project.pictures / "measures.json"
    values = read_json(measures) if measures.exists() else {}
    known = {key: value for key, value in values.items() if value is not None}
    write_page(
        run,
        project.page,
        title=project.out.absolute().name,
        notes=f"Made from {given.words}. The same folder contains {', '.join(named)}.",
        measures=in_words(known),
        **page_options(run),
    )
