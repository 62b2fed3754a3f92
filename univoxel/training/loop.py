"""The training loop and its losses."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from univoxel.camera import pixel_rays
from univoxel.color import linear_to_srgb, linear_to_srgb_unclipped
from univoxel.config import LossConfig, StageConfig, TrainConfig
from univoxel.core import memmap
from univoxel.core.records import Rays, Surface
from univoxel.data import Photos
from univoxel.data.photos import unpacked
from univoxel.lights import base
from univoxel.lights.base import Regularisation
from univoxel.ops import sum_rows
from univoxel.optim import RowAdam, geometric, parameters_of, rows_of
from univoxel.render import metrics
from univoxel.render.metrics import psnr
from univoxel.render.pipeline import at_rays, radiance_of, shade, surface_at
from univoxel.scene import Scene, save_scene
from univoxel.training import descent, patches
from univoxel.training.pixels import TrainingPixels
from univoxel.training.progress import Listener

# Cadences: steps from one to the next. CHECK of descent.py is a share of the schedule; reports
# and checkpoints come by time, REPORT_SECONDS and CHECKPOINT_SECONDS in progress.py
REFRESH = 16  # looks at which bricks are empty
RETRACE = 100  # traces of light through the surface as it has become
COMPARE_EVERY = 2  # comparisons of patches: in each step they bring little more, at twice the cost
SMOOTH_EVERY = 4  # smoothings of what the step has touched
# Of so many rays one is compared with a place beside it, for which networks are evaluated again:
# priors need no more
COMPARED = 4
# Sharpness of the density that is tried in the end, over that of the last stage
SHARPNESS_FACTORS = (0.7, 0.85, 1.0, 1.2, 1.4, 1.7, 2.0)
MIN_OPACITY = 0.5  # rays that meet less are not shaded: their surface is a silhouette's fringe

# Rate of cameras that are refined, at the start and the end of a stage: radians, radii
LR_POSES = (1e-3, 1e-4)
# Weights of how much materials change over about a voxel, L1
ALBEDO_SMOOTHNESS, ROUGHNESS_SMOOTHNESS = 0.005, 0.02


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


def run_stage(
    scene: Scene, cfg: TrainConfig, stage: StageConfig, pixels: TrainingPixels, progress: Listener
) -> None:
    """Optimise the scene on its present grid until the stage's steps or its time are over."""
    field, clock = scene.field, progress.clock
    scene.train()
    optimizer = build_optimizer(scene, stage.refit)
    plateau = descent.Plateau(cfg.patience)
    guard = descent.Guard(progress, restored=lambda: restore_surface_(scene))
    guard.follow(optimizer)
    brightness = None  # of photographs whose patches are compared
    if cfg.loss.patches and stage.patches_from < 1 and not memmap.on_disk(pixels.photos.color):
        brightness = patches.comparable(pixels.photos)
    shown: dict[str, Tensor] = {}  # losses; where patches are not compared, as they were last
    with scene.surface_held():
        for done in clock.steps():
            # The schedule
            physical = done >= stage.physical_from
            rates = learning_rates(stage, done, field.voxel_size)
            for group, rate in zip(optimizer.param_groups, rates, strict=True):
                group["lr"] = rate * guard.scale
            scene.inv_s = 1 / (geometric(stage.sharpness, done) * field.voxel_size)

            # What follows the surface as it moves
            if clock.step % REFRESH == 0:
                before = field.sdf, field.features
                if field.refresh():
                    guard.forget()
                optimizer.follow(before[0], field.sdf)
                optimizer.follow(before[1], field.features)
            if clock.step % RETRACE == 0 and not stage.refit:
                scene.release_surface()

            # A batch of rays, and the generator of all that is random in it
            drawn = pixels.trained[torch.randint(len(pixels.trained), (stage.rays,))]
            draw = torch.Generator().manual_seed(int(torch.randint(2**62, (1,))))
            photos = scene.registered(pixels.photos)
            batch = batch_at(photos, drawn)

            # Losses. What is read beside the surface has a gradient of its own: torch adds sparse
            # ones slowly
            beside = field.features.detach().requires_grad_()
            surface = surface_at(scene, batch.rays, torch.rand(stage.rays, generator=draw))
            terms = losses_of(scene, cfg.loss, surface, batch, physical, draw, beside)
            look = done >= stage.patches_from and clock.step % COMPARE_EVERY == 0
            if look and brightness is not None:
                seen = photos.cameras, surface, batch.wo, drawn
                differ = patches.disagreement(scene, brightness, *seen)
                terms["patches"] = cfg.loss.patches * differ
            loss = torch.stack(list(terms.values())).sum()

            # Backward, and a step if its numbers are sound
            optimizer.zero_grad(set_to_none=True)
            wanted = [p for p in parameters_of(optimizer) if p.requires_grad]
            loss.backward(inputs=[*wanted, beside])
            add_gradient_(field.features, beside.grad)
            if not guard.sound(loss):
                continue
            shown |= {name: term.detach() for name, term in terms.items()}
            if stage.refit:
                field.hold_channels_(scene.material.channels)
            if stage.spread:
                descent.smooth_sdf_gradient_(field, stage.spread)
            optimizer.step()
            if clock.step % SMOOTH_EVERY == 0 and not stage.refit:
                descent.smooth_touched_(field, stage, SMOOTH_EVERY)

            # Held-out pixels, the report, a checkpoint
            if plateau.due(done):
                quality = held_out_psnr(scene, pixels.photos, pixels.held_out, physical)
                if plateau.flat(done, quality, physical):
                    clock.shorten()
            if progress.due():
                quality = held_out_psnr(scene, pixels.photos, pixels.held_out, physical)
                progress.report({k: v.item() for k, v in shown.items()}, quality)
                guard.judge(quality, physical)
            if progress.checkpoint_due():
                save_scene(scene, cfg.out, progress.state())
    field.refresh()
    scene.eval()


def add_gradient_(table: Tensor, gradient: Tensor | None) -> None:
    """Add a sparse gradient to that of a table [..., C], which is sparse too; None: nothing."""
    if gradient is None:
        return
    assert table.grad is not None
    both = table.grad, gradient
    rows, values = [rows_of(g) for g in both], [g._values() for g in both]
    index, total = sum_rows(rows, values, table.shape[:-1])
    table.grad = torch.sparse_coo_tensor(
        index,
        total,
        table.shape,
        is_coalesced=True,
        check_invariants=False,  # ascending and inside by construction
    )


def restore_surface_(scene: Scene) -> None:
    """After parameters went back: look again at what follows from them, even if it is held."""
    scene.field.refresh()
    scene.release_surface()


def build_optimizer(scene: Scene, refit: bool) -> RowAdam:
    """Adam over what a stage trains, in the groups of `learning_rates`; the rest is frozen.

    Args:
        refit: materials stay. Only then there is a network for what is mirrored sharply: before,
            it would take the materials' gloss upon itself.
    """
    field = scene.field
    field.sdf.requires_grad_()
    scene.material.requires_grad_(not refit)
    networks = [scene.material, scene.radiance, scene.light]
    if scene.mirrored:
        scene.mirrored.requires_grad_(refit)
        networks.append(scene.mirrored)
    if scene.views:
        scene.views.gain_steps.requires_grad_(not refit)
        networks.append(scene.views)
    if scene.flash:
        scene.flash.requires_grad_(not refit)
        networks.append(scene.flash)
    table, poses = scene.radiance.directions.table, []
    if scene.poses is not None:
        scene.poses.requires_grad_(not refit)
        poses = [scene.poses.steps]
    return RowAdam(
        [
            {"params": [field.sdf], "eps": descent.EPS_SDF},
            {"params": [field.features, table], "eps": descent.EPS_FEATURES},
            {"params": [p for net in networks for p in net.parameters() if p is not table]},
            {"params": poses},
        ],
        betas=descent.MOMENTS,
    )


def learning_rates(stage: StageConfig, done: float, voxel_size: float) -> tuple[float, ...]:
    """Of distances (world units), features, networks and poses, at progress in [0, 1)."""
    return (
        geometric(stage.lr_sdf, done) * voxel_size,
        geometric(stage.lr_features, done),
        geometric(stage.lr_networks, done),
        geometric(LR_POSES, done),
    )


def losses_of(
    scene: Scene,
    weight: LossConfig,
    surface: Surface,
    batch: Batch,
    physical: bool,
    draw: torch.Generator,
    features: Tensor | None = None,
) -> dict[str, Tensor]:
    """Every loss of a batch but that of patches, weighted.

    Args:
        draw: of all that is random.
        features: the field's, read beside the surface: for a gradient apart from that at the
            surface. The field's own when left out.
    """
    opacity, alpha = surface.opacity[:, None], batch.alpha[:, None]
    # A random background: otherwise a surface of the background's colour explains empty space.
    behind = torch.rand(batch.color.shape, generator=draw)
    target = linear_to_srgb(batch.color * alpha + behind * (1 - alpha))
    radiance = radiance_of(scene, surface, batch.wo, batch.view)
    drawn = radiance * opacity + linear_to_srgb(behind) * (1 - opacity)
    terms = {
        "radiance": weight.radiance * metrics.photometric(drawn, target),
        "silhouette": weight.silhouette * metrics.silhouette(surface.opacity, batch.alpha),
    }
    hit = (surface.opacity.detach() > MIN_OPACITY).nonzero()[:, 0]
    if not physical or not len(hit):
        return terms

    met, view = at_rays(surface, hit), batch.view[hit]
    opacity, behind, target = opacity[hit], behind[hit], target[hit]
    shaded = shade(scene, met, batch.wo[hit], draw, view)
    encoded = linear_to_srgb_unclipped(shaded * opacity + behind * (1 - opacity))
    assert met.metallic is not None
    terms |= {
        "physical": metrics.photometric(encoded, target),
        "metallic": weight.metallic * met.metallic.mean(),
    }
    some = torch.arange(0, len(hit), COMPARED)
    return terms | smoothness_losses(scene, weight, at_rays(met, some), view[some], draw, features)


def smoothness_losses(
    scene: Scene,
    weight: LossConfig,
    met: Surface,
    view: Tensor,
    draw: torch.Generator,
    features: Tensor | None,
) -> dict[str, Tensor]:
    """Weighted priors: material and light change little from points to places beside them.

    Args:
        view: [N] as in `shade`.
        draw, features: as in `losses_of`.
    """
    away = scene.field.voxel_size * torch.randn(met.position.shape, generator=draw)
    beside = met.position.detach() + away
    near = scene.field.features_at(beside, features)
    albedo, roughness, _ = scene.material(near)
    here = replace(met, features=scene.coded(met.features, view))
    near = replace(met, features=scene.coded(near, view), position=beside)
    terms = {
        "albedo": ALBEDO_SMOOTHNESS * base.smoothness(met.albedo, albedo),
        "roughness": ROUGHNESS_SMOOTHNESS * base.smoothness(met.roughness, roughness),
    }
    return terms | light_priors(scene.light.regularisation(here, near), weight)


def light_priors(prior: Regularisation, weight: LossConfig) -> dict[str, Tensor]:
    """The priors that a light has, each times its weight."""
    terms = {name: term for name, term in vars(prior).items() if term is not None}
    return {name: getattr(weight, name) * term for name, term in terms.items()}


def batch_at(photos: Photos, pixels: Tensor) -> Batch:
    """The rays of pixels as `TrainingPixels` has them."""
    view, row, column = pixels[:, :3].long().unbind(1)
    if pixels.shape[1] == 3:
        color, alpha = photos.pixels(view, row, column)
    else:
        color, alpha = unpacked(photos, pixels[:, 3:])
    centre = torch.stack([column, row], 1) + 0.5
    return Batch(view, pixel_rays(photos.cameras, view, centre), color, alpha)


@torch.no_grad()
def fit_sharpness_(scene: Scene, pixels: TrainingPixels) -> None:
    """Give the density the sharpness with which validation pixels are drawn best.

    A stage ends with one that is even over the grid. How wide a silhouette's fringe has to be
    depends on the pixels too, and on how well masks and surface agree. Masks whose edges were
    moved, or are doubted and left out, do not tell it: most fringes look too wide beside them.
    """
    if not pixels.edges_given:
        return
    before = scene.inv_s
    found = {}
    for factor in SHARPNESS_FACTORS:
        scene.inv_s = factor * before
        found[factor] = held_out_psnr(scene, pixels.photos, pixels.held_out, physical=True)
    scene.inv_s = max(found, key=found.__getitem__) * before


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
