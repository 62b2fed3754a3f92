"""The training loop, and what it minimises."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from univoxel import losses
from univoxel.camera import pixel_rays
from univoxel.checkpoint import save_scene
from univoxel.color import linear_to_srgb
from univoxel.config import TrainConfig
from univoxel.data import Photos
from univoxel.lights import priors
from univoxel.metrics import psnr
from univoxel.optim import RowAdam
from univoxel.records import Rays, Surface
from univoxel.render.pipeline import at_rays, radiance_of, shade, surface_at
from univoxel.scene import Scene
from univoxel.training.config import LossConfig, StageConfig
from univoxel.training.divergence import Guard
from univoxel.training.plateau import Plateau
from univoxel.training.progress import Progress, Rehearsal
from univoxel.training.surface_update import (
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


@dataclass(frozen=True)
class TrainingPixels:
    """Photographs, and which of their pixels [P, 3] (view, row, column) serve what."""

    photos: Photos
    trained: Tensor
    held_out: Tensor  # only looked at, to follow quality


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
    pixels: TrainingPixels,
    scene: Scene,
    stage: StageConfig,
    steps: int,
) -> float:
    """Hurry a scene through a stage, without light; PSNR of its held-out pixels."""
    photos, held_out = pixels.photos, pixels.held_out
    torch.manual_seed(cfg.seed)  # all rehearsals see the same rays
    # From middling rates on: what has been learned must not be shaken
    rates = {n: (math.sqrt(a * b), b) for n in RATES for a, b in [getattr(stage, n)]}
    stage, cfg = replace(stage, physical_from=1.0, **rates), replace(cfg, patience=0.0)
    run_stage(scene, cfg, stage, photos, pixels.trained, held_out, Rehearsal(steps))
    return held_out_psnr(scene, photos, held_out, physical=False)


def objective(
    scene: Scene, weight: LossConfig, surface: Surface, batch: Batch, physical: bool
) -> dict[str, Tensor]:
    """Every term that is minimised, weighted."""
    opacity, alpha = surface.opacity[:, None], batch.alpha[:, None]
    # A random background: otherwise a surface of the background's colour explains empty space.
    behind = torch.rand_like(batch.color)
    target = linear_to_srgb(batch.color * alpha + behind * (1 - alpha))
    radiance = radiance_of(scene, surface, batch.wo, batch.view)
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
        shaded = radiance_of(scene, surface, batch.wo, batch.view) * surface.opacity[:, None]
    target = linear_to_srgb(batch.color * batch.alpha[:, None])
    return psnr(shaded, target)
