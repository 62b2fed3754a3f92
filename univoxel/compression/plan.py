"""What is chosen when, so that a model is no larger than its scene needs.

No grid is finer than the photographs, and no finer than the budget has room for. Capacity that
adapts chooses more: after the first stage with light the levels of the table of mirrored
directions; at the end how far from the surface nodes are stored, and which rows of a hash table.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from torch import Tensor

from univoxel.camera import Cameras, pixel_width
from univoxel.checkpoint import SHELL
from univoxel.compression import search
from univoxel.compression.search import ReferenceRays, random_reference_rays, reference_rays
from univoxel.compression.storage import (
    FEWEST_VOXELS,
    fit_budget_,
    shortest_reach,
    voxels_that_fit,
)
from univoxel.config import StageConfig, TrainConfig
from univoxel.data import Photos
from univoxel.fields.dense import DenseDistances
from univoxel.fields.features import NodeFeatures
from univoxel.grid import fit_grid
from univoxel.scene import Scene
from univoxel.training.choices import CapacityChoice, chosen_reach, chosen_voxels
from univoxel.training.pixels import TrainingPixels

# Rays of the training photographs in a batch whose gradients weigh rows: what memory of one
# backward pass bounds
ROW_PROBE_RAYS = 4096
# Batches of ROW_PROBE_RAYS. A row that none of them meets is kept, so few batches drop fewer rows
ROW_PROBES = 8


def adapt_(
    scene: Scene, cfg: TrainConfig, index: int, pixels: TrainingPixels
) -> list[CapacityChoice]:
    """Fit the sizes of a scene to what stage `index` left, and say in order what was chosen."""
    photos = scene.registered(pixels.photos)
    held_out = reference_rays(photos, pixels.held_out)
    stage, after = cfg.stages[index], cfg.stages[index + 1 :]
    choices: list[CapacityChoice] = []
    if after and isinstance(after[0], StageConfig) and not after[0].refit:
        choices += grid_in_budget(scene, cfg, after[0])
    if isinstance(stage, StageConfig) and not stage.refit and stage.physical_from < 1:
        if scene.cfg.mirror_levels:
            choices.append(search.fewer_mirror_levels_(scene, held_out))
    if not after:
        choices += reduce_storage_(scene, cfg, held_out, photos, pixels.trained)
    return choices


def grid_in_budget(scene: Scene, cfg: TrainConfig, stage: StageConfig) -> list[CapacityChoice]:
    """The voxels of a coming stage that the budget has room for, where it has not for all."""
    if not cfg.budget_mb:
        return []
    limit = round(1e6 * stage.voxels)
    most = voxels_that_fit(scene, 1e6 * cfg.budget_mb)
    if most >= limit:
        return []
    return [CapacityChoice("voxels", limit, most, 0.0, f"the budget leaves room for {most:,}")]


def reduce_storage_(
    scene: Scene, cfg: TrainConfig, held_out: ReferenceRays, photos: Photos, pixels: Tensor
) -> list[CapacityChoice]:
    """Decide what the file of a finished scene leaves out, drop rows of its hash table, and bring
    it into the budget; say what was chosen.

    Args:
        photos: with cameras as they are registered.
        pixels: that were trained on [P, 3]; their rays probe rows.
    """
    choices = []
    if isinstance(scene.field.distances, DenseDistances):
        choices.append(shortest_reach(scene, held_out))
    if not isinstance(scene.field.encoding, NodeFeatures):
        far = (chosen_reach(choices) or SHELL) * scene.field.voxel_size
        probes = (  # drawn one by one: each is dropped before the next is
            random_reference_rays(photos, pixels, ROW_PROBE_RAYS) for _ in range(ROW_PROBES)
        )
        choices.append(search.fewer_rows_(scene, held_out, probes, far, search.TOLERANCE_DB))
    if cfg.budget_mb:
        choices += fit_budget_(scene, held_out, chosen_reach(choices), 1e6 * cfg.budget_mb)
    return choices


def on_grid(stage: StageConfig, box: tuple[Tensor, Tensor], voxel_size: float) -> StageConfig:
    """A stage with its sharpness, which counts in voxels of its own grid, for those of another.

    Edges stay as sharp in the world as on the finest grid: what a coarse grid cannot say is bends
    of the surface, not the place of an edge.
    """
    own_size = fit_grid(*box, round(1e6 * stage.voxels)).voxel_size
    begin, end = (s * min(own_size / voxel_size, 1.0) for s in stage.sharpness)
    return replace(stage, sharpness=(begin, end))


def limited_to_pixels(
    cfg: TrainConfig, cameras: Cameras, box: tuple[Tensor, Tensor]
) -> TrainConfig:
    """The same with no grid finer than the photographs are: voxels of cfg.voxel_pixels pixels or
    more, as half of the cameras see them at the middle of the box."""
    if not cfg.voxel_pixels:
        return cfg
    lower, upper = box
    pixel = pixel_width(cameras, (lower + upper) / 2)
    most = float((upper - lower).prod()) / (cfg.voxel_pixels * pixel) ** 3
    most = max(most, FEWEST_VOXELS) / 1e6
    stages = (
        replace(s, voxels=min(s.voxels, most)) if isinstance(s, StageConfig) else s
        for s in cfg.stages
    )
    return replace(cfg, stages=tuple(stages))


def stage_voxels(stage: StageConfig, choices: Iterable[CapacityChoice]) -> int:
    """Voxels of a stage's grid: its own, or fewer where that was chosen."""
    own = round(1e6 * stage.voxels)
    chosen = chosen_voxels(choices)
    return own if chosen is None else min(own, chosen)
