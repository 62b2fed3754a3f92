"""Photographs in, a scene out: what training does, in order."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from univoxel import ranks, shelf
from univoxel.build import build_scene
from univoxel.checkpoint import FILE, load_checkpoint, save_scene
from univoxel.compression import plan, storage
from univoxel.compression.choices import chosen_reach
from univoxel.confidence.report import numbers, words
from univoxel.confidence.survey import survey
from univoxel.config import TrainConfig, check_same, save_config
from univoxel.data import Photos, keep_photos, load_photos
from univoxel.errors import Cancelled, ExistingFile, UserError
from univoxel.files import replacing
from univoxel.grid import fit_grid
from univoxel.joint import stage as joint_stage
from univoxel.joint.config import JointConfig
from univoxel.ops import native
from univoxel.pictures.timelapse import Timelapse
from univoxel.preparation.pinned import PinnedHull
from univoxel.preparation.prepare import Silhouettes, find_silhouettes, pinned_in, prepare
from univoxel.render.picture import preview
from univoxel.run import kept_photos
from univoxel.scene import Scene
from univoxel.training.clock import Clock
from univoxel.training.config import StageConfig
from univoxel.training.loop import fit_sharpness_, run_stage
from univoxel.training.memory import check_memory
from univoxel.training.pixels import TrainingPixels, split_pixels
from univoxel.training.progress import LOG, Progress, TrainingProgress

if TYPE_CHECKING:
    from univoxel.viewer.training import Spectators

log: logging.Logger = logging.getLogger("univoxel")


def train(
    cfg: TrainConfig,
    resume: bool = False,
    timelapse: str | Path | None = None,
    on_progress: Callable[[TrainingProgress], None] | None = None,
    view: tuple[str, int] | None = None,
) -> Path:
    """Train a scene; leave model, log, preview, configuration and trust.txt in cfg.out; return it.

    Args:
        resume: go on with the run in cfg.out from its last checkpoint; begin where there is none.
        timelapse: .gif, .mp4 or folder for pictures of a view over training time; making them does
            not count as time.
        on_progress: called every few seconds. Where it raises `Cancelled` the run is saved, and can
            be resumed.
        view: host and port that browsers may look at the training at, while it goes; port 0: any
            free one. A button there ends it early, with a result.

    Raises:
        MissingExtra: view without viser.
        MissingNative: the compiled extension is missing or was built without Embree.
        DataError: input that cannot be used.
        ExistingFile: cfg.out holds a run already and resume is False.
        OSError: a file of the run cannot be written; what was there before stays.
        UserError: with resume, the checkpoint cannot be read, or it belongs to another
            configuration; or training needs more memory than there is; or the port is taken.
    """
    if not native.reference_asked():
        native.require_embree("train")  # now, and not minutes later
    if ranks.began_by_torchrun() and (view is not None or timelapse is not None):
        what = "timelapse" if view is None else "view"
        raise UserError(f"{what} is of trainings in one process, not under torchrun", what)
    film = None if timelapse is None else Timelapse(timelapse, cfg)
    if view is None:
        with ranks.joined(), shelf.shelved(cfg.out):
            return _train(cfg, resume, film, None, on_progress)
    from univoxel.viewer.training import watched

    with watched(*view, cfg.out.resolve().name) as spectators, shelf.shelved(cfg.out):
        log.info(f"to look at while it trains, in a browser: {spectators.address}")
        return _train(cfg, resume, film, spectators, on_progress)


def _train(
    cfg: TrainConfig,
    resume: bool,
    film: Timelapse | None,
    spectators: Spectators | None,
    on_progress: Callable[[TrainingProgress], None] | None,
) -> Path:
    """`train`, with those who look at it between steps."""
    torch.manual_seed(cfg.seed)
    kept, outside = kept_photos(cfg.out, "train"), cfg.allow_outside
    with ranks.in_turn():
        photos = load_photos(cfg.data, "train", cfg.downscale, kept=kept, allow_outside=outside)
        if ranks.count() > 1 and ranks.leads():  # the others need not shrink them again
            cfg.out.mkdir(parents=True, exist_ok=True)
            keep_photos(photos, kept)
    cfg = replace(cfg, downscale=photos.downscale)
    if not resume and (cfg.out / FILE).exists():
        raise ExistingFile(
            f"{cfg.out} holds a run already: pass resume or another out", "resume", "out"
        )
    log.info(photos.about)
    check_memory(photos, cfg)

    begin = ranks.tick()  # only now: how long reading takes is the photographs' affair
    silhouettes = find_silhouettes(photos, cfg)
    pixels = split_pixels(silhouettes.photos, silhouettes.distance, silhouettes.doubted)
    pixels = replace(pixels, edges_given=silhouettes.edges_given)
    limited = plan.limited_to_pixels(cfg, photos.cameras, silhouettes.box)
    scene, state, pinned = start(silhouettes, cfg, limited, resume)
    cfg.out.mkdir(parents=True, exist_ok=True)  # only now: nothing is left of what cannot be used
    if ranks.leads():
        if not state:  # of a run that was killed before anything was saved
            (cfg.out / LOG).unlink(missing_ok=True)
        save_config(cfg)
        keep_photos(photos, kept)
    begin -= state.get("seconds", 0.0)
    if spectators:
        spectators.show(pixels.photos)
    told = _told(spectators, on_progress)
    with Progress(limited, begin, state, told) as progress:
        progress.clock.watch = _between_steps(scene, progress.clock, film, spectators)
        try:
            for index in range(progress.clock.stage, len(cfg.stages)):
                make_stage_(scene, limited, index, silhouettes.box, pinned, pixels, progress)
        except Cancelled:
            if ranks.leads():
                save_scene(scene, cfg.out, progress.state())
            raise
        if film:
            film.finish(scene, progress.clock)
    if ranks.leads():
        with ranks.alone():
            save_trust(scene, pixels.photos, cfg, progress.troubles)
    return cfg.out


def _told(
    spectators: Spectators | None, on_progress: Callable[[TrainingProgress], None] | None
) -> Callable[[TrainingProgress], None] | None:
    """What takes the reports of a training."""
    if spectators is None:
        return on_progress

    def told(now: TrainingProgress) -> None:
        spectators.tell(now)
        if on_progress is not None:
            on_progress(now)

    return told


def _between_steps(
    scene: Scene, clock: Clock, film: Timelapse | None, spectators: Spectators | None
) -> Callable[[], None] | None:
    """What is done between steps, off the clock."""
    if film is None and spectators is None:
        return None

    def between() -> None:
        if film:
            film.take_frame(scene, clock)
        if spectators:
            spectators.look(scene, clock)

    return between


def start(
    silhouettes: Silhouettes, cfg: TrainConfig, limited: TrainConfig, resume: bool
) -> tuple[Scene, dict[str, Any], PinnedHull | None]:
    """The scene that training begins or goes on with, the state of its run, and what is pinned.

    Args:
        cfg: as it was asked for.
        limited: the same with grids no finer than the photographs.
    """
    if resume and not (cfg.out / FILE).is_file():
        log.info(f"nothing was saved in {cfg.out} yet: training begins")
        resume = False
    if not resume:
        prepared = prepare(silhouettes, limited)
        return build_scene(prepared, limited), {}, prepared.pinned
    scene, state = load_checkpoint(cfg.out)
    check_same(cfg)
    return scene, state, pinned_in(silhouettes, scene, limited)


def make_stage_(
    scene: Scene,
    cfg: TrainConfig,
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
    if isinstance(stage, StageConfig):
        bring_to_grid_(scene, stage, box, progress)
    if pinned is not None:
        pinned.pin_(scene.field)
    if isinstance(stage, JointConfig):
        rows = storage.sky_rows(stage.mirror.rows, cfg.budget_mb)
        stage = replace(stage, mirror=replace(stage.mirror, rows=rows))
        joint_stage.solve(scene, scene.registered(photos), stage, cfg.seed, progress)
    else:
        if cfg.capacity == "adaptive":
            stage = plan.on_grid(stage, box, scene.field.voxel_size)
        run_stage(scene, cfg, stage, pixels, progress)
    last = index + 1 == len(cfg.stages)
    if last:
        fit_sharpness_(scene, pixels)
    if cfg.capacity == "adaptive" and (last or not progress.clock.over):
        progress.chosen += plan.adapt_(scene, cfg, index, pixels)
    if not ranks.leads():
        return
    reach, state = chosen_reach(progress.chosen), progress.state()
    with ranks.alone():
        save_scene(scene, cfg.out, state, slim=last, reach=reach)
        preview(scene, scene.registered(photos), cfg.out / "preview.png")


def bring_to_grid_(
    scene: Scene, stage: StageConfig, box: tuple[torch.Tensor, torch.Tensor], progress: Progress
) -> None:
    """Bring the scene's field to the grid of a stage."""
    grid = fit_grid(*box, plan.stage_voxels(stage, progress.chosen))
    if stage.field == "sparse" and scene.field.kind != "sparse":
        scene.field = scene.field.in_bricks(grid)
    elif scene.field.grid != grid:
        scene.field = scene.field.resized(grid)


def save_trust(scene: Scene, photos: Photos, cfg: TrainConfig, troubles: list[str]) -> None:
    """Write to the run's trust.txt, and log, what the photographs leave open."""
    try:
        surveyed = survey(scene, photos, cfg.confidence.report_points)
        text = words(numbers(surveyed), troubles)
    except UserError as error:
        text = f"No trust report: {error}."
    with replacing(cfg.out / "trust.txt") as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")
    log.info(text)
