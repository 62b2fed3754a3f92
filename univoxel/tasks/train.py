"""Photographs in, a scene out: the training loop from top to bottom."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import rich
import torch
from rich.text import Text
from torch import Tensor

from univoxel import lights, losses
from univoxel.camera import pixel_rays
from univoxel.color import linear_to_srgb, srgb_to_linear
from univoxel.config import (
    JointConfig,
    LossConfig,
    StageConfig,
    TrainConfig,
    check_same,
    save_config,
)
from univoxel.data import DataError, Photos, load_photos
from univoxel.data.images import replacing
from univoxel.fields.base import AbstractField
from univoxel.fields.dense import DenseField
from univoxel.fields.hashed import PER_LEVEL, HashField, Levels
from univoxel.fields.hull import GridShape, fit_grid, visual_hull
from univoxel.fields.sparse import SparseField
from univoxel.lights import priors
from univoxel.metrics import psnr
from univoxel.optim import RowAdam
from univoxel.records import Rays, Surface
from univoxel.render.picture import preview
from univoxel.render.pipeline import at_rays, shade, surface_at
from univoxel.scene import FILE, Scene, load_checkpoint, save_scene
from univoxel.tasks import capacity, joint, trust
from univoxel.tasks.descent import (
    EPS_FEATURES,
    EPS_SDF,
    MOMENTS,
    REFRESH,
    SMOOTH_EVERY,
    between,
    moved,
    smooth,
    spread_gradient,
)
from univoxel.tasks.exposures import exposures
from univoxel.tasks.guard import Guard
from univoxel.tasks.hollows import opened
from univoxel.tasks.plateau import Plateau
from univoxel.tasks.progress import Progress, Rehearsal
from univoxel.tasks.registration import masks_of, object_box, put_right
from univoxel.tasks.timelapse import Timelapse

MARGIN = 6.0  # pixels around the silhouettes that are trained on; farther ones are empty
HELD_OUT = 2048  # pixels of the training photographs that are only looked at, to follow quality
RETRACE = 100  # steps after which light is traced through the surface as it has become
RATES = ("lr_sdf", "lr_features", "lr_networks")
MIN_OPACITY = 0.5  # rays that meet less are not shaded: their surface is a silhouette's fringe


@dataclass(frozen=True)
class Batch:
    """Rays, and what the photographs show there."""

    view: Tensor  # [N] int64
    rays: Rays
    color: Tensor  # [N, 3] linear, straight
    alpha: Tensor  # [N]

    @property
    def wo(self) -> Tensor:
        return -self.rays.direction


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
    asked, cfg = cfg, capacity.within_pixels(cfg, photos.cameras, box)
    if resume:
        scene, state = load_checkpoint(cfg.out)
        check_same(asked)
        begin -= state["seconds"]
    else:
        assert isinstance(cfg.stages[0], StageConfig)
        first = fit_grid(*box, capacity.voxels(cfg.stages[0], []))
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
            mirror_levels=capacity.mirror_levels(cfg.scene, cfg.budget_mb),
        )
        scene = Scene(own, field)
        if poses:
            scene.poses = poses
        if scene.views and gains is not None:
            scene.views.add(gains[:, None].expand(-1, 3))
        state = {"stage": 0, "progress": 0.0, "step": 0}
        if cfg.budget_mb is not None:
            capacity.check_budget(scene, cfg.budget_mb)

    cfg.out.mkdir(parents=True, exist_ok=True)  # only now: nothing is left of what cannot be used
    save_config(asked)
    with Progress(cfg, begin, state) as progress:
        if film:
            progress.watch = lambda: film.look(scene, progress)
        for index in range(state["stage"], len(cfg.stages)):
            stage = cfg.stages[index]
            if isinstance(stage, JointConfig):
                joint.solve(scene, scene.registered(photos), stage, cfg.seed, progress)
            else:
                grid = fit_grid(*box, capacity.voxels(stage, progress.chosen))
                if stage.field == "sparse" and not isinstance(scene.field, SparseField):
                    scene.field = SparseField.around(scene.field, grid)
                elif scene.field.grid != grid:
                    scene.field = scene.field.resized(grid)
                if cfg.capacity == "adaptive":
                    stage = capacity.on_grid(stage, box, grid.voxel_size)
                run_stage(scene, cfg, stage, photos, pixels, held_out, progress)
            done = index + 1 == len(cfg.stages)
            if cfg.capacity == "adaptive" and (done or not progress.over):
                rehearse = partial(rehearsal, cfg, photos, pixels, held_out)
                shot = scene.registered(photos)
                looks = look_at(shot, held_out), partial(random_look, shot, pixels)
                chosen = capacity.adapt(scene, cfg, index, box, *looks, rehearse, progress.pace)
                progress.chosen += [choice.noted() for choice in chosen]
                if not done and capacity.rehearsed(scene, chosen):
                    progress.credit(capacity.REHEARSAL)
            reach = capacity.reach(progress.chosen)
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
    finest = min(fit_grid(*box, capacity.voxels(s, [])).voxel_size for s in stages)
    rows = capacity.table_rows(cfg.scene, cfg.budget_mb)
    levels = Levels.of(grid.bounds(), finest, cfg.scene.channels // PER_LEVEL, rows)
    return HashField(DenseField(grid, 0, hull), levels)


def say_trust(scene: Scene, photos: Photos, out: Path, troubles: list[str]) -> None:
    """Print, and write to trust.txt, what the photographs leave open."""
    try:
        told = trust.words(trust.numbers(trust.survey(scene, photos, trust.FEW_POINTS)), troubles)
    except ValueError as error:
        told = f"No trust report: {error}."
    with replacing(out / "trust.txt") as temporary:
        temporary.write_text(told + "\n", encoding="utf-8")
    rich.print(Text(told))


def run_stage(
    scene: Scene,
    cfg: TrainConfig,
    stage: StageConfig,
    photos: Photos,
    pixels: Tensor,
    held_out: Tensor,
    progress: Progress | Rehearsal,
) -> None:
    """Optimise the scene on its present grid until the stage's steps or its time are over."""
    field = scene.field
    scene.train()
    scene.surface_moved()
    field.sdf.requires_grad_()
    scene.material.requires_grad_(not stage.refit)
    networks = [scene.material, scene.radiance, scene.light]
    if scene.mirrored:  # only with fixed materials: before, it would take their gloss upon itself
        scene.mirrored.requires_grad_(stage.refit)
        networks.append(scene.mirrored)
    if scene.views:
        scene.views.gain_steps.requires_grad_(not stage.refit)
        networks.append(scene.views)
    table, poses = scene.radiance.directions.table, []
    if scene.poses is not None:
        scene.poses.requires_grad_(not stage.refit)
        poses = [scene.poses.steps]
    optimizer = RowAdam(
        [
            {"params": [field.sdf], "eps": EPS_SDF},
            {"params": [field.features, table], "eps": EPS_FEATURES},
            {"params": [p for net in networks for p in net.parameters() if p is not table]},
            {"params": poses},
        ],
        betas=MOMENTS,
    )
    plateau = Plateau(cfg.patience)
    guard = Guard(progress, restored=lambda: moved(scene))
    guard.follow(optimizer)
    for done in progress.steps():
        physical = done >= stage.physical_from
        rates = (
            between(stage.lr_sdf, done) * field.voxel_size,
            between(stage.lr_features, done),
            between(stage.lr_networks, done),
            between(stage.lr_poses, done),
        )
        for group, rate in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = rate * guard.scale
        scene.inv_s = 1 / (between(stage.sharpness, done) * field.voxel_size)
        if progress.step % REFRESH == 0:
            before = field.sdf, field.features
            if field.refresh():
                guard.forget()
            optimizer.follow(before[0], field.sdf)
            optimizer.follow(before[1], field.features)
        if progress.step % RETRACE == 0 and not stage.refit:
            scene.surface_moved()

        batch = random_batch(scene.registered(photos), pixels, stage.rays)
        surface = surface_at(scene, batch.rays, torch.rand(stage.rays))
        terms = objective(scene, cfg.loss, surface, batch, physical)
        loss = torch.stack(list(terms.values())).sum()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        if not guard.sound(loss):
            continue
        if stage.refit:
            field.hold_channels_(scene.material.channels)
        if stage.spread:
            spread_gradient(field, stage.spread)
        optimizer.step()
        if progress.step % SMOOTH_EVERY == 0 and not stage.refit:
            smooth(field, stage)
        if plateau.due(done):
            quality = held_out_psnr(scene, photos, held_out, physical)
            if plateau.flat(done, quality, physical):
                progress.shorten()
        if progress.due():
            quality = held_out_psnr(scene, photos, held_out, physical)
            progress.report({k: v.item() for k, v in terms.items()}, quality)
            guard.judge(quality, physical)
        if progress.checkpoint_due():
            save_scene(scene, cfg.out, progress.state())
    moved(scene)
    scene.eval()


def rehearsal(
    cfg: TrainConfig,
    photos: Photos,
    pixels: Tensor,
    held_out: Tensor,
    scene: Scene,
    stage: StageConfig,
    steps: int,
) -> float:
    """Hurry a scene through a stage, without light; PSNR of its held-out pixels."""
    torch.manual_seed(cfg.seed)  # all rehearsals see the same rays
    # From middling rates on: what has been learned must not be shaken
    rates = {n: (math.sqrt(a * b), b) for n in RATES for a, b in [getattr(stage, n)]}
    stage, cfg = replace(stage, physical_from=1.0, **rates), replace(cfg, patience=0.0)
    run_stage(scene, cfg, stage, photos, pixels, held_out, Rehearsal(steps))
    return held_out_psnr(scene, photos, held_out, physical=False)


def objective(
    scene: Scene, weight: LossConfig, surface: Surface, batch: Batch, physical: bool
) -> dict[str, Tensor]:
    """Every term that is minimised, weighted."""
    opacity, alpha = surface.opacity[:, None], batch.alpha[:, None]
    # A random background: otherwise a surface of the background's colour explains empty space.
    behind = torch.rand_like(batch.color)
    target = linear_to_srgb(batch.color * alpha + behind * (1 - alpha))
    radiance = encoded_radiance(scene, surface, batch)
    drawn = radiance * opacity + linear_to_srgb(behind) * (1 - opacity)
    terms = {
        "radiance": weight.radiance * losses.photometric(drawn, target),
        "silhouette": weight.silhouette * losses.silhouette(surface.opacity, batch.alpha),
    }
    hit = (surface.opacity.detach() > MIN_OPACITY).nonzero()[:, 0]
    if not physical or not len(hit):
        return terms

    met, view = at_rays(surface, hit), batch.view[hit]
    opacity, behind, target = opacity[hit], behind[hit], target[hit]
    shaded = shade(scene, met, batch.wo[hit], torch.default_generator, view)
    encoded = losses.encode(shaded * opacity + behind * (1 - opacity))
    beside = met.position.detach() + scene.field.voxel_size * torch.randn_like(met.position)
    near = scene.field.features_at(beside)
    albedo, roughness, _ = scene.material(near)
    assert met.metallic is not None
    here = replace(met, features=scene.coded(met.features, view))
    near = replace(met, features=scene.coded(near, view), position=beside)
    prior = scene.light.regularisation(here, near)
    terms |= {
        "physical": losses.photometric(encoded, target),
        "albedo": weight.albedo_smoothness * priors.smoothness(met.albedo, albedo),
        "roughness": weight.roughness_smoothness * priors.smoothness(met.roughness, roughness),
        "metallic": weight.metallic * met.metallic.mean(),
    }
    return terms | {name: getattr(weight, name) * value for name, value in prior.items()}


def encoded_radiance(scene: Scene, surface: Surface, batch: Batch) -> Tensor:
    """What the radiance head says of the photographs' rays: [N, 3], sRGB-encoded."""
    features = scene.coded(surface.features, batch.view)
    encoded = scene.radiance(features, surface.normal, batch.wo)
    if scene.views is None:
        return encoded
    return losses.encode(scene.exposed(srgb_to_linear(encoded), batch.view))


def split_pixels(distance: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels [P, 3] (view, row, column) in or near silhouettes: to train on, and held out."""
    pixels = (distance < MARGIN).nonzero()
    order = torch.randperm(len(pixels), generator=torch.Generator().manual_seed(0))
    held = min(HELD_OUT, len(pixels) // 10)
    if not held:  # so few that none can be spared
        return pixels, pixels
    return pixels[order[held:]], pixels[order[:held]]


def random_batch(photos: Photos, pixels: Tensor, count: int) -> Batch:
    """`count` of the pixels, drawn with replacement."""
    return batch_at(photos, pixels[torch.randint(len(pixels), (count,))])


def batch_at(photos: Photos, pixels: Tensor) -> Batch:
    view, row, column = pixels.unbind(1)
    color, alpha = photos.pixels(view, row, column)
    centre = torch.stack([column, row], 1) + 0.5
    return Batch(view, pixel_rays(photos.cameras, view, centre), color, alpha)


@torch.no_grad()
def held_out_psnr(scene: Scene, photos: Photos, pixels: Tensor, physical: bool) -> float:
    """PSNR in sRGB on black over held-out pixels, of the physically based render once there is one
    and of the radiance head before."""
    batch = batch_at(scene.registered(photos), pixels)
    surface = surface_at(scene, batch.rays)
    if physical:
        shaded = shade(scene, surface, batch.wo, view=batch.view)
        shaded = linear_to_srgb(shaded * surface.opacity[:, None])
    else:
        shaded = encoded_radiance(scene, surface, batch) * surface.opacity[:, None]
    target = linear_to_srgb(batch.color * batch.alpha[:, None])
    return psnr(shaded, target)


def random_look(photos: Photos, pixels: Tensor, count: int) -> capacity.Look:
    """`look_at` some of the pixels, `count` at most."""
    return look_at(photos, pixels[torch.randperm(len(pixels))[:count]])


def look_at(photos: Photos, pixels: Tensor) -> capacity.Look:
    """Pixels as capacity looks at them."""
    batch = batch_at(photos, pixels)
    target = linear_to_srgb(batch.color * batch.alpha[:, None])
    return capacity.Look(
        batch.rays,
        batch.view,
        target,
        radiance=lambda scene, surface: encoded_radiance(scene, surface, batch),
    )
