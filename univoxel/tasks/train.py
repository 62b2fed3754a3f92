"""Photographs in, a scene out: the training loop from top to bottom."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import rich
import torch
from rich.text import Text
from torch import Tensor

from univoxel import confidence, lights
from univoxel.checkpoint import FILE, load_checkpoint, save_scene
from univoxel.compression import plan, sizes
from univoxel.compression.choices import chosen_reach
from univoxel.config import TrainConfig, check_same, save_config
from univoxel.data import Photos, load_photos
from univoxel.errors import DataError
from univoxel.fields.base import AbstractField
from univoxel.fields.dense import DenseField
from univoxel.fields.hashed import PER_LEVEL, HashField, Levels
from univoxel.fields.sparse import SparseField
from univoxel.files import replacing
from univoxel.grid import GridShape, fit_grid
from univoxel.joint import stage as joint_stage
from univoxel.joint.config import JointConfig
from univoxel.pictures.timelapse import Timelapse
from univoxel.preparation.carving import opened
from univoxel.preparation.exposures import exposures
from univoxel.preparation.hull import visual_hull
from univoxel.preparation.masks import masks_of
from univoxel.preparation.registration import object_box, put_right
from univoxel.render.picture import preview
from univoxel.scene import Scene
from univoxel.training.config import StageConfig
from univoxel.training.loop import TrainingPixels, run_stage
from univoxel.training.progress import Progress

MARGIN = 6.0  # pixels around the silhouettes that are trained on; farther ones are empty
HELD_OUT = 2048  # pixels of the training photographs that are only looked at, to follow quality


def train(cfg: TrainConfig, resume: bool = False, timelapse: str | Path | None = None) -> Path:
    """Train a scene; leave model, log, preview, configuration and trust.txt in cfg.out; return it.

    Args:
        timelapse: .gif, .mp4 or folder for pictures of a view over training time, which making
            them does not count in.

    Raises:
        DataError: input that cannot be used.
        FileExistsError: cfg.out holds a run already and resume is False.
        OSError: a file of the run cannot be written; what was there before stays.
        FileNotFoundError, ValueError: with resume, there is no checkpoint that can be read, or it
            belongs to another configuration.
    """
    film = None if timelapse is None else Timelapse(timelapse, cfg)
    torch.manual_seed(cfg.seed)
    photos = load_photos(cfg.data, "train", cfg.downscale)
    if not resume and (cfg.out / FILE).exists():
        raise FileExistsError(f"{cfg.out} holds a run already: pass --resume or another --out")
    print(photos.about)

    begin = time.monotonic()  # only now: how long reading takes is the photographs' affair
    photos, distance = masks_of(photos, cfg.masks)
    pixels, held_out = split_pixels(distance)
    try:
        box, refined = object_box(distance, photos.cameras, cfg.cameras)
    except ValueError as error:
        raise DataError(f"{cfg.data}: {error}") from None
    asked, cfg = cfg, plan.limited_to_pixels(cfg, photos.cameras, box)
    if resume:
        scene, state = load_checkpoint(cfg.out)
        check_same(asked)
        begin -= state["seconds"]
    else:
        assert isinstance(cfg.stages[0], StageConfig)
        first = fit_grid(*box, plan.stage_voxels(cfg.stages[0], []))
        poses = put_right(distance, photos.cameras, box) if refined else None
        cameras = poses.corrected(photos.cameras) if poses else photos.cameras
        hull = visual_hull(distance, cameras, first)
        there = replace(photos, cameras=cameras)
        varying, gains = exposures(there, hull, first, cfg.scene.varying, cfg.exposures)
        if cfg.hollows and varying != "light":
            hull = opened(hull, first, there, gains, cfg.hollows * 60 * cfg.minutes)
        field = first_field(cfg, first, hull, box)
        light = lights.scaled(cfg.scene.light, float((box[1] - box[0]).max()) / 2)
        views = tuple(photos.names) if refined or varying != "none" else ()
        own = replace(
            cfg.scene,
            light=light,
            varying=varying,
            refined=refined,
            views=views,
            mirror_levels=sizes.mirror_levels(cfg.scene, cfg.budget_mb, cfg.compression),
        )
        scene = Scene(own, field)
        if poses:
            scene.poses = poses
        if scene.views and gains is not None:
            scene.views.add(gains[:, None].expand(-1, 3))
        state = {"stage": 0, "progress": 0.0, "step": 0}
        if cfg.budget_mb is not None:
            sizes.check_budget(scene, cfg.budget_mb, cfg.compression)

    cfg.out.mkdir(parents=True, exist_ok=True)  # only now: nothing is left of what cannot be used
    save_config(asked)
    with Progress(cfg, begin, state) as progress:
        if film:
            progress.watch = lambda: film.look(scene, progress)
        for index in range(state["stage"], len(cfg.stages)):
            stage = cfg.stages[index]
            if isinstance(stage, JointConfig):
                joint_stage.solve(scene, scene.registered(photos), stage, cfg.seed, progress)
            else:
                grid = fit_grid(*box, plan.stage_voxels(stage, progress.chosen))
                if stage.field == "sparse" and not isinstance(scene.field, SparseField):
                    scene.field = SparseField.around(scene.field, grid)
                elif scene.field.grid != grid:
                    scene.field = scene.field.resized(grid)
                if cfg.capacity == "adaptive":
                    stage = plan.on_grid(stage, box, grid.voxel_size)
                run_stage(scene, cfg, stage, photos, pixels, held_out, progress)
            done = index + 1 == len(cfg.stages)
            if cfg.capacity == "adaptive" and (done or not progress.over):
                split = TrainingPixels(photos, pixels, held_out)
                choices = plan.adapt_(scene, cfg, index, box, split, progress.pace)
                progress.chosen += choices
                if not done and plan.begun_in_rehearsal(scene, choices):
                    progress.credit(cfg.compression.rehearsal_share)
            reach = chosen_reach(progress.chosen)
            save_scene(scene, cfg.out, progress.state(), slim=done, reach=reach)
            preview(scene, scene.registered(photos), cfg.out / "preview.png")
        if film:
            film.finish(scene, progress)
    say_trust(scene, photos, cfg.out, progress.troubles)
    return cfg.out


def first_field(
    cfg: TrainConfig, grid: GridShape, hull: Tensor, box: tuple[Tensor, Tensor]
) -> AbstractField:
    """The field that training starts with, on the grid of the first stage."""
    stages = [s for s in cfg.stages if isinstance(s, StageConfig)]
    if stages[0].field != "hash":
        return DenseField(grid, cfg.scene.channels, hull)
    finest = min(fit_grid(*box, plan.stage_voxels(s, [])).voxel_size for s in stages)
    rows = sizes.table_rows(cfg.scene, cfg.budget_mb, cfg.compression)
    levels = Levels.of(grid.bounds(), finest, cfg.scene.channels // PER_LEVEL, rows)
    return HashField(DenseField(grid, 0, hull), levels)


def say_trust(scene: Scene, photos: Photos, out: Path, troubles: list[str]) -> None:
    """Print, and write to trust.txt, what the photographs leave open."""
    try:
        told = confidence.words(
            confidence.numbers(confidence.survey(scene, photos, confidence.FEW_POINTS)), troubles
        )
    except ValueError as error:
        told = f"No trust report: {error}."
    with replacing(out / "trust.txt") as temporary:
        temporary.write_text(told + "\n", encoding="utf-8")
    rich.print(Text(told))


def split_pixels(distance: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels [P, 3] (view, row, column) in or near silhouettes: to train on, and held out."""
    pixels = (distance < MARGIN).nonzero()
    order = torch.randperm(len(pixels), generator=torch.Generator().manual_seed(0))
    held = min(HELD_OUT, len(pixels) // 10)
    if not held:  # so few that none can be spared
        return pixels, pixels
    return pixels[order[held:]], pixels[order[:held]]
