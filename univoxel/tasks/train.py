"""Photographs in, a scene out: the training loop from top to bottom."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path

import rich
import torch
from rich.text import Text
from torch import Tensor

from univoxel import confidence
from univoxel.build import build_scene
from univoxel.checkpoint import FILE, load_checkpoint, save_scene
from univoxel.color import linear_to_srgb
from univoxel.compression import plan
from univoxel.config import TrainConfig, check_same, save_config
from univoxel.data import Photos, load_photos
from univoxel.fields.sparse import SparseField
from univoxel.files import replacing
from univoxel.grid import fit_grid
from univoxel.joint import stage as joint_stage
from univoxel.joint.config import JointConfig
from univoxel.pictures.timelapse import Timelapse
from univoxel.preparation.prepare import find_silhouettes, prepare
from univoxel.render.picture import preview
from univoxel.scene import Scene
from univoxel.training.loop import batch_at, rehearsal, run_stage
from univoxel.training.pixels import split_pixels
from univoxel.training.progress import Progress


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
    silhouettes = find_silhouettes(photos, cfg)
    photos, box = silhouettes.photos, silhouettes.box
    pixels, held_out = split_pixels(silhouettes.distance)
    asked, cfg = cfg, plan.within_pixels(cfg, photos.cameras, box)
    if resume:
        scene, state = load_checkpoint(cfg.out)
        check_same(asked)
        begin -= state["seconds"]
    else:
        scene = build_scene(prepare(silhouettes, cfg), cfg)
        state = {"stage": 0, "progress": 0.0, "step": 0}

    cfg.out.mkdir(parents=True, exist_ok=True)  # only now: nothing is left of what cannot be used
    save_config(asked)
    with Progress(cfg, begin, state) as progress:
        if film:
            progress.clock.watch = lambda: film.look(scene, progress.clock)
        for index in range(state["stage"], len(cfg.stages)):
            stage = cfg.stages[index]
            if isinstance(stage, JointConfig):
                joint_stage.solve(scene, scene.registered(photos), stage, cfg.seed, progress)
            else:
                grid = fit_grid(*box, plan.voxels(stage, progress.chosen))
                if stage.field == "sparse" and not isinstance(scene.field, SparseField):
                    scene.field = SparseField.around(scene.field, grid)
                elif scene.field.grid != grid:
                    scene.field = scene.field.resized(grid)
                if cfg.capacity == "adaptive":
                    stage = plan.on_grid(stage, box, grid.voxel_size)
                run_stage(scene, cfg, stage, photos, pixels, held_out, progress)
            done = index + 1 == len(cfg.stages)
            if cfg.capacity == "adaptive" and (done or not progress.clock.over):
                rehearse = partial(rehearsal, cfg, photos, pixels, held_out)
                shot = scene.registered(photos)
                looks = look_at(shot, held_out), partial(random_look, shot, pixels)
                chosen = plan.adapt(scene, cfg, index, box, *looks, rehearse, progress.clock.pace)
                progress.chosen += [choice.noted() for choice in chosen]
                if not done and plan.rehearsed(scene, chosen):
                    progress.clock.count_as_done(plan.REHEARSAL)
            reach = plan.reach(progress.chosen)
            save_scene(scene, cfg.out, progress.state(), slim=done, reach=reach)
            preview(scene, scene.registered(photos), cfg.out / "preview.png")
        if film:
            film.finish(scene, progress.clock)
    say_trust(scene, photos, cfg.out, progress.troubles)
    return cfg.out


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


def random_look(photos: Photos, pixels: Tensor, count: int) -> plan.Look:
    """`look_at` some of the pixels, `count` at most."""
    return look_at(photos, pixels[torch.randperm(len(pixels))[:count]])


def look_at(photos: Photos, pixels: Tensor) -> plan.Look:
    """Pixels as capacity looks at them."""
    batch = batch_at(photos, pixels)
    target = linear_to_srgb(batch.color * batch.alpha[:, None])
    return plan.Look(batch.rays, batch.view, target)
