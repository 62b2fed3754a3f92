"""The steps of a training, from photographs to a scene."""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from univoxel import config, lights
from univoxel.cli.detail import made_after_training, minutes_left, seconds_for
from univoxel.core import log, memmap
from univoxel.core.files import write_text
from univoxel.core.progress_bar import duration
from univoxel.core.system import release_memory
from univoxel.data import Photos, keep_photos, load_photos
from univoxel.data.path_sandbox import FEWEST
from univoxel.errors import Cancelled, DataError, ExistingFile, UserError
from univoxel.evaluation.confidence import REPORT_POINTS, Survey, numbers, survey, words
from univoxel.fields.field import PER_LEVEL, Field, Levels, dense_field, hash_field
from univoxel.fields.grid import fit_grid
from univoxel.ops import native
from univoxel.output.timelapse import Timelapse
from univoxel.preparation.hull_constraint import PinnedHull
from univoxel.preparation.prepare import Prepared, find_silhouettes, pinned_in, prepare
from univoxel.render.pictures import preview
from univoxel.render.pipeline import surface_at
from univoxel.run import FILE as VERDICT
from univoxel.run import Evidence, Verdict, judge, kept_photos, save_verdict, save_world
from univoxel.scene import FILE, Scene, load_checkpoint, save_scene
from univoxel.training import compression
from univoxel.training import joint_solve as joint_stage
from univoxel.training.clock import LEAST, RESERVE_SECONDS
from univoxel.training.loop import batch_at, fit_sharpness_, held_out_psnr, run_stage
from univoxel.training.pixels import TrainingPixels, check_memory, most_pixels, split_pixels
from univoxel.training.probe import slowdown
from univoxel.training.progress import LOG, Progress, TrainingProgress, chosen_reach

if TYPE_CHECKING:
    from univoxel.viewer.training import Spectators


# Of preparation, a million pixels that are trained on, on two quiet cores of a Xeon
PREPARATION_SECONDS = 0.5
PAGE_SECONDS = 8.0  # of the page, or the mesh, that follows a training
SLACK = 0.05  # of a limit that training may take of what detail was left


def train(
    cfg: config.TrainConfig,
    resume: bool = False,
    timelapse: str | Path | None = None,
    on_progress: Callable[[TrainingProgress], None] | None = None,
    view: tuple[str, int] | None = None,
) -> Path:
    """Train a scene; write model, log, preview, configuration, verdict.json and trust.txt to
    cfg.out; return it.

    Args:
        resume, timelapse, on_progress, view: as in `univoxel.train`. If there is no checkpoint to
            resume from, training starts; recording images does not count as time.

    Raises:
        MissingExtra: view without viser.
        MissingNative: the compiled extension is missing or was built without Embree.
        UserError: data, checkpoint or options cannot be used, or need more memory than there is.
        OSError: a file of the run cannot be written; what was there before stays.
    """
    if not native.reference_asked():
        native.require_embree("train")  # now, and not minutes later
    film = None if timelapse is None else Timelapse(timelapse, cfg)
    if view is None:
        with memmap.large_arrays_in(cfg.out):
            return _train(cfg, resume, film, None, on_progress)
    from univoxel.viewer.training import watched

    with watched(*view, cfg.out.resolve().name) as spectators, memmap.large_arrays_in(cfg.out):
        log.info(f"Watch the training in a browser: {spectators.address}")
        return _train(cfg, resume, film, spectators, on_progress)


def _train(
    cfg: config.TrainConfig,
    resume: bool,
    film: Timelapse | None,
    spectators: Spectators | None,
    on_progress: Callable[[TrainingProgress], None] | None,
) -> Path:
    """`train`, with those who look at it between steps."""
    begin = time.monotonic()
    torch.manual_seed(cfg.seed)
    if not resume and (cfg.out / FILE).exists():
        raise ExistingFile(
            f"{cfg.out} already contains a run: pass resume, or choose another folder for out",
            *("resume", "out"),
        )
    kept, outside = kept_photos(cfg.out, "train"), cfg.allow_outside
    photos = load_photos(cfg.data, "train", cfg.downscale, kept=kept, allow_outside=outside)
    cfg = replace(cfg, downscale=photos.downscale)
    log.info(photos.about)
    if len(photos) < FEWEST:
        raise DataError(f"{cfg.data}: expected at least {FEWEST} photographs, got {len(photos)}")
    check_memory(photos, cfg)
    begun = resumed(cfg) if resume else None
    state = begun[1] if begun else {}
    (cfg.out / VERDICT).unlink(missing_ok=True)  # of a run that continues
    shutil.rmtree(cfg.out / "detail", ignore_errors=True)  # as well

    begin -= state.get("seconds", 0.0)
    told = _each(spectators and spectators.tell, on_progress)
    left = minutes_left(cfg.minutes, photos, cfg.detail, torch.get_num_threads())
    timed = replace(cfg, minutes=left)
    with Progress(timed, begin, state, told, slowdown(timed)) as progress:
        after = seconds_for(photos, cfg.detail, torch.get_num_threads()) + PAGE_SECONDS
        progress.clock.afterwards = progress.slower * after
        announce(progress, photos)
        scene, pinned, pixels, limited, box = ready(photos, cfg, begun and begun[0], progress)
        release_memory()  # preparation frees about 12 bytes a pixel
        cfg.out.mkdir(parents=True, exist_ok=True)  # only now: nothing is left of what fails
        if not state:  # of a run that was killed before anything was saved
            (cfg.out / LOG).unlink(missing_ok=True)
        config.save_config(cfg)
        save_world(photos.moved, cfg.out)
        keep_photos(photos, kept)
        if spectators:
            spectators.show(pixels.photos)
        progress.prepared()
        watchers = film and film.take_frame, spectators and spectators.look
        now = scene, progress.clock
        progress.clock.watch = _each(*(look and partial(look, *now) for look in watchers))
        try:
            for index in range(progress.clock.stage, len(cfg.stages)):
                make_stage_(scene, limited, index, box, pinned, pixels, progress)
        except Cancelled:
            save_scene(scene, cfg.out, progress.state())
            raise
        if film:
            film.finish(scene, progress.clock)
    surveyed = trusted(scene, pixels.photos)
    verdict = judge(evidence(scene, pixels, progress, surveyed))
    save_verdict(verdict, cfg.out)
    save_trust(verdict, surveyed, progress.troubles, cfg)
    until = (
        None if cfg.minutes is None or left is None else begin + 60 * (left + SLACK * cfg.minutes)
    )
    made_after_training(scene, pixels.photos, cfg.out, cfg.detail, until)
    for choice in progress.chosen:
        log.debug(choice.sentence)
    for line in verdict.lines():
        log.info(line)
    return cfg.out


def ready(
    photos: Photos, cfg: config.TrainConfig, begun: Scene | None, progress: Progress
) -> tuple[Scene, PinnedHull | None, TrainingPixels, config.TrainConfig, tuple[Tensor, Tensor]]:
    """What the stages train on: the scene, the frozen hull, the pixels, the configuration with its
    grids limited to what the pixels resolve, and the box.

    The distances to silhouettes, four bytes a pixel, are freed when it returns.

    Args:
        begun: the scene of a run that continues.
    """
    silhouettes = find_silhouettes(photos, cfg, progress.preparing)
    shown = silhouettes.photos, silhouettes.distance, silhouettes.doubted
    pixels = split_pixels(*shown, most_pixels(cfg))
    pixels = replace(pixels, edges_given=silhouettes.edges_given)
    limited = compression.limited_to_pixels(cfg, photos.cameras, silhouettes.box)
    if begun:
        pinned = pinned_in(silhouettes, begun, limited, progress.preparing)
        return begun, pinned, pixels, limited, silhouettes.box
    prepared = prepare(silhouettes, limited, progress.preparing)
    return build_scene(prepared, limited), prepared.pinned, pixels, limited, silhouettes.box


def build_scene(prepared: Prepared, cfg: config.TrainConfig) -> Scene:
    """A scene whose surface is the carved hull, with poses and gains as far as they are known.

    Draws the first weights from torch's generator. A UserError if cfg.budget_mb is too small.
    """
    silhouettes, varying = prepared.silhouettes, prepared.varying
    lower, upper = silhouettes.box
    field = build_field(prepared, cfg)
    views = tuple(silhouettes.photos.names) if silhouettes.refined or varying != "none" else ()
    sized = replace(
        cfg.scene,
        light=lights.scaled(cfg.scene.light, float((upper - lower).max()) / 2),
        varying=varying,
        turntable=prepared.frame.turntable,
        flash=prepared.frame.flash,
        refined=silhouettes.refined,
        views=views,
        mirror_levels=compression.mirror_levels(cfg.scene, cfg.budget_mb),
    )
    scene = Scene(sized, field)
    if prepared.poses:
        scene.poses = prepared.poses
    if scene.views and prepared.gains is not None:
        scene.views.add(prepared.gains[:, None].expand(-1, 3))
    if cfg.budget_mb is not None:
        compression.check_budget(scene, cfg.budget_mb)
    return scene


def build_field(prepared: Prepared, cfg: config.TrainConfig) -> Field:
    """The field of the first stage, its surface that of the carved hull."""
    grid, hull, box = prepared.grid, prepared.hull, prepared.silhouettes.box
    stages = [s for s in cfg.stages if isinstance(s, config.StageConfig)]
    if stages[0].field != "hash":
        return dense_field(grid, cfg.scene.channels, hull)
    finest = min(fit_grid(*box, compression.stage_voxels(s, [])).voxel_size for s in stages)
    rows = compression.table_rows(cfg.scene, cfg.budget_mb)
    levels = Levels.of(grid.bounds(), finest, cfg.scene.channels // PER_LEVEL, rows)
    return hash_field(grid, levels, hull)


def resumed(cfg: config.TrainConfig) -> tuple[Scene, dict[str, Any]] | None:
    """The scene that a run continues with, and its state; None if nothing was saved yet. A
    UserError if the run cannot be read, or is of another configuration."""
    if not (cfg.out / FILE).is_file():
        log.info(f"{cfg.out}: nothing has been saved yet, so training starts from the beginning")
        return None
    scene, state = load_checkpoint(cfg.out)
    config.check_same(cfg)
    return scene, state


def announce(progress: Progress, photos: Photos) -> None:
    """Log the expected time on this machine, and what a time limit leaves out."""
    clock, cfg = progress.clock, progress.cfg
    pixels = len(photos) * photos.cameras.width * photos.cameras.height / 1e6
    before = clock.seconds + PREPARATION_SECONDS * progress.slower * pixels
    steps = before + clock.planned + RESERVE_SECONDS
    whole = steps + clock.afterwards
    size = photos.downscale**2 * pixels / len(photos)
    what = f"{len(photos)} photographs of {size:.2g} megapixels"
    clock.preparation = min(before, config.PREPARATION * clock.limit)
    said = f"{what}: training takes about {duration(whole)} on this machine"
    if steps <= clock.limit:
        log.info(said)
        return
    fits = max(clock.limit - clock.preparation - RESERVE_SECONDS, 0.0) / clock.planned
    said += f"; minutes={cfg.minutes:g} allows "
    if fits < 1:
        said += f"about {fits:.0%} of the steps"
    else:
        said += f"all steps, if preparation takes at most {duration(clock.preparation)}"
    if fits < LEAST:
        said += f"; to run all steps, use minutes={math.ceil(whole / 60)}"
    log.info(said, extra={"arguments": ("minutes",)})


def evidence(
    scene: Scene, pixels: TrainingPixels, progress: Progress, surveyed: Survey | None
) -> Evidence:
    """The evidence for the verdict on a training."""
    clock, held_out = progress.clock, pixels.held_out
    batch = batch_at(scene.registered(pixels.photos), held_out)
    with torch.no_grad():
        surface = surface_at(scene, batch.rays)
    wrong = (surface.opacity - batch.alpha).abs() > 0.5
    shares = numbers(surveyed) if surveyed else {}
    return Evidence(
        steps=clock.short(),
        stopped=clock.finished,
        minutes=clock.minutes_for_all(),
        limit=progress.cfg.minutes,
        psnr=held_out_psnr(scene, pixels.photos, held_out, physical=True),
        outline=wrong.float().mean().item(),
        hidden=shares.get("few_views"),
        residual=shares.get("disagreeing"),
        troubles=len(progress.troubles),
    )


def _each(*calls: Callable[..., None] | None) -> Callable[..., None] | None:
    """What calls all that there are, one after another; None: there are none."""
    known = [call for call in calls if call is not None]

    def call_each(*arguments: Any) -> None:
        for call in known:
            call(*arguments)

    return call_each if known else None


def make_stage_(
    scene: Scene,
    cfg: config.TrainConfig,
    index: int,
    box: tuple[torch.Tensor, torch.Tensor],
    pinned: PinnedHull | None,
    pixels: TrainingPixels,
    progress: Progress,
) -> None:
    """Run a stage on the scene, fit the model to what comes after it, and save both.

    Args:
        box: corners [3], [3] of the grids.
        pinned: where the surface stays; None: nowhere.
    """
    stage, photos = cfg.stages[index], pixels.photos
    if isinstance(stage, config.StageConfig):
        grid = fit_grid(*box, compression.stage_voxels(stage, progress.chosen))
        if stage.field == "sparse" and scene.field.kind != "sparse":
            scene.field = scene.field.in_bricks(grid)
        elif scene.field.grid != grid:
            scene.field = scene.field.resized(grid)
    if pinned is not None:
        pinned.pin_(scene.field)
    if isinstance(stage, config.JointConfig):
        joint_stage.solve(scene, scene.registered(photos), stage, cfg.seed, progress)
    else:
        if cfg.capacity == "adaptive":
            stage = compression.on_grid(stage, box, scene.field.voxel_size)
        run_stage(scene, cfg, stage, pixels, progress)
    last = index + 1 == len(cfg.stages)
    if last:
        fit_sharpness_(scene, pixels)
    if cfg.capacity == "adaptive" and (last or not progress.clock.over):
        progress.chosen += compression.adapt_(scene, cfg, index, pixels)
    reach, state = chosen_reach(progress.chosen), progress.state()
    save_scene(scene, cfg.out, state, slim=last, reach=reach)
    preview(scene, scene.registered(photos), cfg.out / "preview.png")


def trusted(scene: Scene, photos: Photos) -> Survey | None:
    """What the photographs tell of the surface; None if there is no surface that they show."""
    try:
        return survey(scene, photos, REPORT_POINTS)
    except UserError as error:
        log.info(f"expected errors are missing: {error}")
        return None


def save_trust(
    verdict: Verdict, surveyed: Survey | None, troubles: list[str], cfg: config.TrainConfig
) -> None:
    """Write the verdict and the expected errors to the run's trust.txt."""
    text = verdict.sentence() + "."
    if surveyed is not None:
        log.debug(expected := words(numbers(surveyed), troubles))
        text += " " + expected
    write_text(cfg.out / "trust.txt", text + "\n")
