"""Camera poses for a folder of photographs or a video, written as a scene to train on."""

from __future__ import annotations

import platform
import shutil
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from univoxel import __version__
from univoxel.capture import model as database
from univoxel.capture import photographs, pose_validation, scene, structure
from univoxel.capture.config import DEFAULTS, CaptureConfig
from univoxel.capture.model import Model, without
from univoxel.capture.photographs import find_photographs, require_readers
from univoxel.capture.prepare import Capture, Folders, gather, in_words, write_pictures
from univoxel.capture.sfm import require_pycolmap
from univoxel.core import files as steps
from univoxel.core import log
from univoxel.core.choices import KEEP_SIZE
from univoxel.core.files import read_json
from univoxel.core.progress_bar import bar
from univoxel.errors import DataError, ExistingFile, StillBackground, some
from univoxel.sphere import gaps

WORK = "sfm"  # folder in the scene that the steps keep their results in
# Steps that are noted in it: those of the search, with its settings, and what is by itself
SEARCH, FRAMES, SCENE = "search", "frames", "scene"
PARTS = FEATURES, PAIRS, MATCHES, MODELS = "features", "choosing pairs", "matching", "placing"
# Share of pairs whose match is a shift only, from where on the background stands still while the
# object turns: on a turntable it was .6, elsewhere 0, with poor masks .04
STILL_SHARE = 0.2
PLACED_SHARE = 0.8  # of the photographs, below which the capture is no use
GAP = 60.0  # degrees between neighbouring directions that are worth a word
# What version 0.2 noted of the configuration that are constants now
CONSTANTS_0_2: dict[str, Any] = {
    **{"coarse_features": 512, "coarse_photographs": 150, "ratio": 0.8, "neighbours": 3},
    **{"mask_margin": 0.006, "still_share": 0.2, "weak_share": 0.2, "weak_points": 50},
    **{"weak_partners": 3, "fitting_share": 0.9, "fitting_pixels": 3.0, "weak_doubt": 0.3},
    **{"contradicted_share": 0.5, "placed_share": 0.8, "gap": 60.0},
    **{"base_seconds": 120.0, "photograph_seconds": 30.0},
}


def poses(
    photographs: str | Path,
    out: str | Path,
    masks: str | Path | None = None,
    every: float | None = None,
    keep_size: int = KEEP_SIZE,
    keep_weak: bool = False,
    config: CaptureConfig = DEFAULTS,
) -> Path:
    """Find the camera poses of photographs and write both as a scene; return out.

    Photographs are written upright. The world has +Z up, its origin is where the cameras look, and
    their median distance from it is 4. After an interruption, call the function again to resume.

    Args:
        photographs: a folder of photographs in any common format, or a video.
        out: folder to write images/, masks/, sparse/0 and poses.json to, and sfm/ for the steps.
        masks: folder with a mask for each photograph; features are detected inside them only.
        every: seconds; the sharpest frame of a video in each such period is taken.
        keep_size: maximum longer side of the written photographs, pixels; 0: any.
        keep_weak: also write photographs with unreliable poses.
        config: how cameras are found.

    Raises:
        MissingExtra: pycolmap or the reader of a format is missing.
        DataError: photographs cannot be used, or too few can be registered. StillBackground: the
            object was rotated in front of a static camera, and there are no masks.
        ExistingFile: out holds something else.
        ProcessFailed: a step failed.
        OSError: a file cannot be written.
    """
    source, out = Path(photographs), Path(out)
    masks = None if masks is None else Path(masks)
    require_pycolmap()
    folders = folders_of(out)
    _check_free(out, folders)
    files, others, doubles = photographs_of(source, folders, every)
    require_readers(files)
    capture, unread = gather(files, masks)
    unread += others
    told = in_words(capture.photographs, capture.groups)
    told += f"; {doubles} photographs exist in two formats, of which one is used" if doubles else ""
    told += f"; {len(unread)} could not be read: {some(sorted(unread))}" if unread else ""
    log.info(told)
    settings = _settings(source, masks, every, config, capture)
    used = {"keep_size": keep_size, "keep_weak": keep_weak}
    if _begin(out, folders, settings, used):
        log.info(f"{out} is complete")
        return out
    with bar(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        TimeRemainingColumn(),
    ) as progress:
        unreadable = _search(capture, folders, config, settings, progress)
        model, weak, reports = _judge(capture, folders, unreadable)
        _say(model, reports, keep_weak)
        model = without(model, set(weak)) if weak and not keep_weak else model
        index = {name: i for i, name in enumerate(capture.pictures)}
        ordered = sorted(model.images, key=lambda i: index[i.name])
        wanted = [index[image.name] for image in ordered]
        model = scene.own_sizes(Model(model.cameras, ordered, model.points), capture, keep_size)
        model, known = scene.gauge_aligned(model)
        if not known:
            log.warning("the world may be tilted: the cameras do not show which way is up")
        names = [image.name for image in model.images]
        centres = np.stack([image.centre for image in model.images])
        for gap in gaps(centres, names, GAP):
            log.info(gap)
        steps.forget(folders.work, SCENE)
        written = scene.write_scene(out, capture, model, wanted, keep_size)
        _follow(progress, "writing", written, len(wanted))
    for i in wanted:
        reports[i] = replace(reports[i], written=scene.written_name(capture.photographs[i]))
    scene.write_report(out, {**settings, **used, "versions": _versions()}, model, reports)
    steps.finish(folders.work, SCENE, used)
    return out


def folders_of(out: Path) -> Folders:
    """Where the work of a scene lies; what version 0.2 left files for is noted as steps."""
    folders = Folders(out / WORK)
    noted, begun = {}, folders.work / "request.json"
    if (frames := folders.frames / "done").exists():
        noted[FRAMES] = read_json(frames)
    if begun.exists():
        settings = read_json(begun)
        config = settings["config"].items()  # where another value was, these are other settings
        settings["config"] = {k: v for k, v in config if CONSTANTS_0_2.get(k) != v}
        marks = {PAIRS: "pairs.txt", MATCHES: "matched", MODELS: "models/done"}
        done = [step for step, name in marks.items() if (folders.work / name).exists()]
        noted |= dict.fromkeys((SEARCH, *done), settings)
    if begun.exists() and (out / scene.REPORT).exists():
        report = read_json(out / scene.REPORT)
        noted[SCENE] = {key: report.get(key) for key in ("keep_size", "keep_weak")}
    steps.adopt(folders.work, noted)
    return folders


def _check_free(out: Path, folders: Folders) -> None:
    """Refuse a folder that holds what is not of a search for cameras."""
    if not out.exists() or (out / scene.REPORT).exists():
        return
    # Written last, one after the other
    begun = scene.WRITTEN if steps.recorded(folders.work, SEARCH) else ()
    foreign = [p.name for p in out.iterdir() if p.name not in (WORK, scene.PARTIAL, *begun)]
    if foreign:
        where = f"{out} contains other files ({foreign[0]})"
        raise ExistingFile(f"{where}: choose another folder for out", "out")


def photographs_of(
    source: Path, folders: Folders, every: float | None = None
) -> tuple[list[Path], list[str], int]:
    """Photographs of a folder or frames of a video; other files; how many came twice."""
    if photographs.is_video(source):
        photographs.require_ffmpeg()
        stamp = [source.name, source.stat().st_size, source.stat().st_mtime, every]
        if steps.recorded(folders.work, FRAMES) != stamp:
            log.info(f"{source}: selecting frames")
            steps.forget(folders.work, FRAMES)
            shutil.rmtree(folders.frames, ignore_errors=True)
            photographs.write_frames(source, folders.frames, every)
            steps.finish(folders.work, FRAMES, stamp)
        return sorted(folders.frames.glob("*.jpg")), [], 0
    if every is not None:
        raise DataError(
            f"{source}: every applies only to videos ({' '.join(photographs.SUFFIXES)})", "every"
        )
    if not source.is_dir():
        raise DataError(f"{source}: expected a folder of photographs or a video")
    return find_photographs(source)


def _settings(
    source: Path, masks: Path | None, every: float | None, config: CaptureConfig, capture: Capture
) -> dict:
    """What decides the cameras: the same settings continue with the same work."""
    files = [p.path for p in capture.photographs] + list(capture.masks or [])
    return {
        "engine": "pycolmap",
        "source": str(source.absolute()),
        "masks": None if masks is None else str(masks.absolute()),
        "every": every,
        "config": asdict(config),
        "files": [[p.name, p.stat().st_size, p.stat().st_mtime] for p in files],
    }


def _begin(out: Path, folders: Folders, settings: dict, written: dict) -> bool:
    """Begin a search, or continue with it; whether all is done already."""
    if (out / scene.REPORT).exists():
        other = ExistingFile(f"{out} contains another scene: choose another folder for out", "out")
        if not steps.done(folders.work, SEARCH, settings, lambda _: other):
            raise other
        return steps.recorded(folders.work, SCENE) == written
    if steps.recorded(folders.work, SEARCH) != steps.as_json(settings):  # and nothing came of it
        # All goes but the frames of a video
        steps.forget(folders.work, SEARCH, *PARTS)
        for path in (folders.pictures, folders.masks, folders.models):
            shutil.rmtree(path, ignore_errors=True)
        for path in (*folders.work.glob("database.db*"), folders.pairs):
            path.unlink(missing_ok=True)
        steps.finish(folders.work, SEARCH, settings)
    return False


def _search(
    capture: Capture, folders: Folders, config: CaptureConfig, settings: dict, progress: Progress
) -> dict[int, str]:
    """All steps up to the models; returns why photographs could not be read, by index."""
    total = len(capture.photographs)
    unreadable = {}
    task = progress.add_task("reading", total=total)
    for index, why in write_pictures(capture, folders, config.size):
        progress.advance(task)
        if why is not None:
            unreadable[index] = why
    if unreadable:
        names = [capture.photographs[i].path.name for i in unreadable]
        log.warning(f"{len(names)} photographs could not be read: {some(sorted(names))}")

    def do(step: str, part: Callable[..., Iterator[int]], total: int) -> None:
        if not steps.done(folders.work, step, settings):
            _follow(progress, step, part(capture, folders, config), total)
            steps.finish(folders.work, step, settings)

    do(FEATURES, structure.extract, total)
    do(PAIRS, structure.select, total)
    pairs = folders.pairs.read_text(encoding="utf-8").splitlines()
    do(MATCHES, structure.match, len(pairs))
    still, matching = pose_validation.still(database.verified_pairs(folders.database))
    if still > STILL_SHARE * matching:
        stands = f"the background is static in {still} of {matching} pairs of photographs"
        if capture.masks is None:
            raise StillBackground(stands)
        raise DataError(
            f"{stands}, and the images in masks include part of it: tighten these masks", "masks"
        )
    do(MODELS, structure.place, total)
    return unreadable


def _follow(progress: Progress, name: str, parts: Iterable[int], total: int) -> None:
    """Show how far a step is while it runs."""
    task = progress.add_task(name, total=total)
    for done in parts:
        progress.update(task, completed=min(done, total))
    progress.update(task, completed=total)


def _judge(
    capture: Capture, folders: Folders, unreadable: dict[int, str]
) -> tuple[Model, dict[int, str], list[scene.Report]]:
    """The largest model; ids of pictures whose poses are not trusted, and why; what is known of
    each photograph."""
    models = database.read_models(folders.models)
    pairs = database.verified_pairs(folders.database)
    features = database.feature_counts(folders.database)
    numbers = database.images(folders.database)
    placed = {i.number: i for i in models[0].images} if models else {}
    elsewhere = {i.number: len(m.images) - 1 for m in reversed(models[1:]) for i in m.images}
    errors: dict[int, float] = {}
    weak: dict[int, str] = {}
    if models:
        errors, images = models[0].errors(), models[0].images
        matches, places = database.matches(folders.database), database.positions(folders.database)
        others = pose_validation.partners(models[0], matches, places)
        doubts = {i.number: pose_validation.doubt(models[0], i, errors[i.number]) for i in images}
        weak = pose_validation.weak({i.number: i.points for i in images}, others, doubts)
    reports = []
    for index, name in enumerate(capture.pictures):
        photograph = capture.photographs[index].path.name
        number = numbers.get(name, (None, None))[0]
        partners = sum(n >= pose_validation.NEEDED for a, b, n, _ in pairs if number in (a, b))
        if number in placed:
            known = True, placed[number].points, errors[number]
            reason = weak.get(number, "")
        else:
            known = False, 0, 0.0
            why_not = pose_validation.why_not(number, features, pairs, elsewhere)
            reason = unreadable.get(index) or why_not
        reports.append(scene.Report(photograph, *known, partners, reason=reason))
    if len(placed) < PLACED_SHARE * len(reports):
        raise DataError(
            f"only {len(placed)} of {len(reports)} photographs were registered. Take more "
            "photographs, with more overlap, and do not move the object. "
            f"Not registered: {some(_explained(reports, placed=False))}"
        )
    return models[0], weak, reports


def _explained(reports: list[scene.Report], placed: bool) -> list[str]:
    """Photographs that were placed, or not, of which there is something to say, and what."""
    return sorted(f"{r.name} ({r.reason})" for r in reports if r.placed == placed and r.reason)


def _say(model: Model, reports: list[scene.Report], keep_weak: bool) -> None:
    """How many were placed, how well, and which not."""
    lenses = [model.cameras[c] for c in sorted({i.camera for i in model.images})]
    shares = some([f"{lens.focal[0] / lens.width:.2f}" for lens in lenses])
    cameras = "one camera" if len(lenses) == 1 else f"{len(lenses)} cameras"
    log.info(
        f"cameras: {len(model.images)} of {len(reports)} photographs registered, mean "
        f"reprojection error {model.error:.2f} pixels, "
        f"focal length {shares} times the width ({cameras})"
    )
    if missing := _explained(reports, placed=False):
        log.warning(f"not registered: {some(missing)}")
    if doubtful := _explained(reports, placed=True):
        fate = "kept" if keep_weak else "left out (keep_weak keeps them)"
        log.warning(
            f"{len(doubtful)} photographs may have poses that are wrong by several degrees. They "
            f"are {fate}: {some(doubtful)}. Photograph the side that they show again, with more "
            "overlap",
            extra={"arguments": ("keep_weak",)},
        )


def _versions() -> dict[str, str]:
    found = {"univoxel": __version__, "python": platform.python_version()}
    for package in ("pycolmap", "pillow", "pillow-heif", "rawpy", "imageio-ffmpeg"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found
