"""A surface in a box and a backdrop around it, fitted to photographs together."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from univoxel import losses
from univoxel.camera import pixel_rays
from univoxel.color import linear_to_srgb
from univoxel.data import Photos
from univoxel.errors import NothingFound
from univoxel.fields.backdrop import Backdrop
from univoxel.fields.field import Field, dense_field
from univoxel.grid import fit_grid
from univoxel.lights.sg import SGConfig
from univoxel.metrics import psnr
from univoxel.optim import RowAdam
from univoxel.render.pipeline import surface_at, surface_of_view
from univoxel.scene import Scene, SceneConfig
from univoxel.segmentation.config import SegmentationConfig
from univoxel.segmentation.distances import redistance_, surface_box
from univoxel.training.config import StageConfig
from univoxel.training.loop import REFRESH, SMOOTH_EVERY
from univoxel.training.surface_update import (
    EPS_FEATURES,
    EPS_SDF,
    MOMENTS,
    geometric,
    smooth_sdf_gradient_,
    smooth_touched_,
)

# Last steps, whose mean PSNR decides which radius is kept
COMPARED_STEPS = 50
# Learning rate at begin and end, of the backdrop's logits
LR_BACKDROP = (0.05, 0.01)
# Weight of the mean opacity at begin and end: what object and backdrop explain alike goes to the
# backdrop, and the ball is carved before it grows. More at the begin loses what looks like the
# room
EMPTINESS = (0.02, 0.0005)
# Steps between turning the sdf back into distances
REDISTANCE_EVERY = 50
# Share of the found box's diagonal, left free around it
MARGIN = 0.05


DEFAULTS = SegmentationConfig()


@dataclass(frozen=True)
class _Parts:
    """What explains the photographs together."""

    scene: Scene
    field: Field  # of the scene
    backdrop: Backdrop


def find_object(
    photos: Photos,
    lower: Tensor,
    upper: Tensor,
    watch: Callable[[float], None],
    cfg: SegmentationConfig = DEFAULTS,
) -> Scene:
    """Surface and radiance of what stands in a box, told from what stands behind it.

    Args:
        photos: as they are; their alpha is not looked at.
        watch: called after each step with the PSNR of its rays.

    Raises:
        NothingFound: there is no object in the box.
    """
    trials: list[tuple[_Parts, float]] = []
    for radius in cfg.radii:
        with suppress(NothingFound):
            parts = _ball(radius, lower, upper, cfg)
            trials.append((parts, separate_(parts, cfg.coarse, photos, watch)))
    if not trials:
        raise NothingFound
    parts, _ = max(trials, key=lambda trial: trial[1])
    redistance_(parts.field, whole=True)
    box = surface_box(parts.field, lower, upper, MARGIN)
    field = parts.field.resized(fit_grid(*box, round(1e6 * cfg.fine.voxels)))
    parts.scene.field = field
    separate_(replace(parts, field=field), cfg.fine, photos, watch)
    redistance_(field, whole=True)
    return parts.scene.eval()


def mask(scene: Scene, photos: Photos, view: int) -> Tensor:
    """Coverage [H, W] of a photograph by the object, in [0, 1]."""
    surface, _ = surface_of_view(scene, photos.cameras, view)
    width, height = photos.cameras.size(view)
    return surface.opacity.view(height, width)


def _ball(radius: float, lower: Tensor, upper: Tensor, cfg: SegmentationConfig) -> _Parts:
    """A ball in the middle of the box, and a backdrop."""
    centre, half = (lower + upper) / 2, (upper - lower) / 2
    backdrop = Backdrop(centre, float(half.norm()))
    grid = fit_grid(lower, upper, round(1e6 * cfg.coarse.voxels))
    ball = (grid.nodes() - centre).norm(dim=-1) - radius * float(half.min())
    sizes = SceneConfig(
        channels=8,
        material_channels=1,
        hidden=32,
        sky_nodes=0,
        mirrored=False,
        light=SGConfig(lobes=1),
    )
    field = dense_field(grid, sizes.channels, ball)
    return _Parts(Scene(sizes, field), field, backdrop)


def _random_pixels(photos: Photos, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """View, row and column of pixels, [count] each: as many of each view, wherever in it."""
    if photos.cameras.sizes is None:
        view, row, column = (
            torch.randint(n, (count,)) for n in (len(photos), *photos.color.shape[1:3])
        )
        return view, row, column
    view = torch.randint(len(photos), (count,))
    width, height = photos.cameras.sizes[view].unbind(1)
    row, column = ((torch.rand(count) * n).long().clamp_max(n - 1) for n in (height, width))
    return view, row, column


def separate_(
    parts: _Parts,
    stage: StageConfig,
    photos: Photos,
    watch: Callable[[float], None],
) -> float:
    """Fit scene and backdrop to the photographs for a stage.

    Returns:
        The mean PSNR of the last steps, dB.

    Raises:
        NothingFound: nothing is left of the surface.
    """
    scene, field, backdrop = parts.scene, parts.field, parts.backdrop
    quality = []
    optimizer = RowAdam(
        [
            {"params": [field.sdf], "eps": EPS_SDF},
            {"params": [field.features], "eps": EPS_FEATURES},
            {"params": list(scene.radiance.parameters())},
            {"params": list(backdrop.parameters())},
        ],
        betas=MOMENTS,
    )
    for step in range(stage.iterations):
        done = step / stage.iterations
        rates = (
            geometric(stage.lr_sdf, done) * field.voxel_size,
            geometric(stage.lr_features, done),
            geometric(stage.lr_networks, done),
            geometric(LR_BACKDROP, done),
        )
        for group, rate in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = rate
        scene.inv_s = 1 / (geometric(stage.sharpness, done) * field.voxel_size)
        redistanced = step % REDISTANCE_EVERY == 0
        if redistanced:
            redistance_(field)
        if redistanced or step % REFRESH == 0:
            field.refresh()
        view, row, column = _random_pixels(photos, stage.rays)
        target = linear_to_srgb(photos.pixels(view, row, column)[0])
        rays = pixel_rays(photos.cameras, view, torch.stack([column, row], 1) + 0.5)
        surface = surface_at(scene, rays, torch.rand(stage.rays))
        opacity = surface.opacity[:, None]
        # The same from all directions: what looks different from each would pass for the backdrop
        front = scene.radiance(surface.features, surface.normal, surface.normal)
        rendered = front * opacity + backdrop(rays) * (1 - opacity)
        loss = losses.photometric(rendered, target) + geometric(EMPTINESS, done) * opacity.mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        smooth_sdf_gradient_(field, stage.spread)
        optimizer.step()
        if step % SMOOTH_EVERY == 0:
            smooth_touched_(field, stage, SMOOTH_EVERY)
        quality.append(psnr(rendered.detach(), target))
        watch(quality[-1])
    last = quality[-COMPARED_STEPS:]
    return sum(last) / len(last)
