"""What is chosen when, so that a model is no larger than its scene needs.

No grid is finer than the photographs. Capacity that adapts chooses more: after the coarse stage,
by rehearsals of the next, the voxels of a dense grid; after the first stage with light its
channels, lobes and hidden units; at the end how far from the surface nodes are stored, and which
rows of a hash table.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable
from dataclasses import replace

from torch import Tensor

from univoxel.camera import Cameras, pixel_width
from univoxel.checkpoint import SHELL
from univoxel.compression import search
from univoxel.compression.choices import CapacityChoice, chosen_reach, chosen_voxels
from univoxel.compression.quality import ReferenceRays, random_reference_rays, reference_rays
from univoxel.compression.sizes import head_share, voxels_that_fit
from univoxel.compression.storage import fit_budget_, shortest_reach
from univoxel.config import TrainConfig
from univoxel.data import Photos
from univoxel.fields.dense import DenseDistances
from univoxel.fields.features import NodeFeatures
from univoxel.grid import fit_grid
from univoxel.lights import LocalSG
from univoxel.scene import Scene
from univoxel.training.config import StageConfig
from univoxel.training.loop import TrainingPixels, rehearsal


def adapt_(
    scene: Scene,
    cfg: TrainConfig,
    index: int,
    box: tuple[Tensor, Tensor],
    pixels: TrainingPixels,
    pace: float = 1.0,
) -> list[CapacityChoice]:
    """Fit the sizes of a scene to what stage `index` left, and say in order what was chosen.

    Args:
        box: corners [3], [3] of the grid.
        pace: share of its steps that time let the last stage make.
    """
    photos = scene.registered(pixels.photos)
    held_out = reference_rays(photos, pixels.held_out)
    stage, after = cfg.stages[index], cfg.stages[index + 1 :]
    choices: list[CapacityChoice] = []
    if after and isinstance(after[0], StageConfig) and not after[0].refit:
        choices += choose_grid_(scene, cfg, after[0], box, pixels, pace)
    if isinstance(stage, StageConfig) and not stage.refit and stage.physical_from < 1:
        constants = cfg.compression
        calibration = random_reference_rays(photos, pixels.trained, constants.calibration_rays)
        channels_limit_db = constants.regained_db if after else constants.tolerance_db
        criterion = search.Criterion(held_out, calibration, constants.tolerance_db, constants)
        choices += reduce_networks_(scene, criterion, channels_limit_db)
    if not after:
        choices += reduce_storage_(scene, cfg, held_out, photos, pixels.trained)
    return choices


def choose_grid_(
    scene: Scene,
    cfg: TrainConfig,
    stage: StageConfig,
    box: tuple[Tensor, Tensor],
    pixels: TrainingPixels,
    pace: float,
) -> list[CapacityChoice]:
    """Bring a dense field to the grid of the coming stage, and say what was chosen.

    Of a hash field only the budget bounds the grid: a node is one number there, and a coarser grid
    costs more than it saves.
    """
    constants = cfg.compression
    limit = most = round(1e6 * stage.voxels)
    if cfg.budget_mb:
        most = min(most, voxels_that_fit(scene, 1e6 * cfg.budget_mb, constants))
    room = f"the budget leaves room for {most:,}"
    if not isinstance(scene.field.encoding, NodeFeatures):
        return [CapacityChoice("voxels", limit, most, 0.0, room)] if most < limit else []
    share = constants.rehearsal_share * pace
    steps = max(constants.rehearsal_steps, round(share * stage.iterations))
    choice = coarsest_grid_(scene, cfg, stage, box, pixels, most, steps)
    if most < limit:
        choice = replace(choice, before=limit, why=f"{room}; {choice.why}")
    return [choice]


def coarsest_grid_(
    scene: Scene,
    cfg: TrainConfig,
    stage: StageConfig,
    box: tuple[Tensor, Tensor],
    pixels: TrainingPixels,
    most: int,
    steps: int,
) -> CapacityChoice:
    """Bring the field to the coarsest grid that a rehearsal of a stage draws as well with.

    Tries grids with `grid_stride` of each other's voxels, all of them: rehearsals are too short to
    err evenly, and coarse grids cost little. The coarsest that ends no more than
    `grid_tolerance_db` below the best is taken, or one with `grid_step` of its voxels, if that does
    too. Every rehearsal begins from the scene as it is; the scene goes on from the one on its grid.

    Args:
        box: corners [3], [3].
        most: voxels of the finest grid.
        steps: of a rehearsal.
    """
    constants = cfg.compression
    psnr: dict[int, float] = {}
    chosen, rehearsed = most, scene

    def rehearse(voxels: int) -> Scene:
        copied = copy.deepcopy(scene)
        copied.field = copied.field.resized(fit_grid(*box, voxels))
        on_it = on_grid(stage, box, copied.field.voxel_size)
        psnr[voxels] = rehearsal(cfg, pixels, copied, on_it, steps)
        return copied

    def good_enough(voxels: int) -> bool:
        return psnr[voxels] >= max(psnr.values()) - constants.grid_tolerance_db

    range_of_sizes = max(most / constants.fewest_voxels, 1)
    for k in range(1 + int(math.log(range_of_sizes, 1 / constants.grid_stride))):
        voxels = round(most * constants.grid_stride**k)
        attempt = rehearse(voxels)
        if good_enough(voxels):
            chosen, rehearsed = voxels, attempt
    if (voxels := round(chosen * constants.grid_step)) >= constants.fewest_voxels:
        attempt = rehearse(voxels)
        if good_enough(voxels):
            chosen, rehearsed = voxels, attempt
    become_(scene, rehearsed)
    why = "held-out rays after rehearsals: "
    why += ", ".join(f"{v:,} {psnr[v]:.2f} dB" for v in sorted(psnr, reverse=True))
    return CapacityChoice("voxels", most, chosen, max(psnr.values()) - psnr[chosen], why)


def become_(scene: Scene, source: Scene) -> None:
    """Give a scene the field, networks and light of another one."""
    scene.field, scene.inv_s = source.field, source.inv_s
    scene.load_state_dict(source.state_dict())


def reduce_networks_(
    scene: Scene, criterion: search.Criterion, channels_limit_db: float
) -> list[CapacityChoice]:
    """Drop channels, mirror levels, lobes and hidden units; say what was chosen."""
    choices = []
    if isinstance(scene.field.encoding, NodeFeatures):
        of_channels = replace(criterion, limit_db=channels_limit_db)
        choices.append(search.fewer_channels_(scene, of_channels))
    if scene.cfg.mirror_levels:
        choices.append(search.fewer_mirror_levels_(scene, criterion))
    if head_share(scene) > criterion.cfg.least_head_share:
        if isinstance(scene.light, LocalSG):
            choices.append(search.fewer_lobes_(scene, criterion))
        choices.append(search.fewer_units_(scene, criterion))
    return choices


def reduce_storage_(
    scene: Scene, cfg: TrainConfig, held_out: ReferenceRays, photos: Photos, pixels: Tensor
) -> list[CapacityChoice]:
    """Decide what the file of a finished scene leaves out, drop rows of its hash table, and bring
    it into the budget; say what was chosen.

    Args:
        photos: with cameras as they are registered.
        pixels: that were trained on [P, 3]; their rays probe rows.
    """
    constants = cfg.compression
    choices = []
    if isinstance(scene.field.distances, DenseDistances):
        choices.append(shortest_reach(scene, held_out, constants))
    if not isinstance(scene.field.encoding, NodeFeatures):
        far = (chosen_reach(choices) or SHELL) * scene.field.voxel_size
        probes = (  # drawn one by one: each is dropped before the next is
            random_reference_rays(photos, pixels, constants.row_probe_rays)
            for _ in range(constants.row_probes)
        )
        limit_db, shares = constants.tolerance_db, constants.dropped_row_shares
        choices.append(search.fewer_rows_(scene, held_out, probes, far, limit_db, shares))
    if cfg.budget_mb:
        reach = chosen_reach(choices)
        choices += fit_budget_(scene, held_out, reach, 1e6 * cfg.budget_mb, constants)
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
    most = max(most, cfg.compression.fewest_voxels) / 1e6
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


def begun_in_rehearsal(scene: Scene, choices: Iterable[CapacityChoice]) -> bool:
    """Whether the coming stage has made its first steps in a rehearsal, as choices tell."""
    by_node = isinstance(scene.field.encoding, NodeFeatures)
    return by_node and chosen_voxels(choices) is not None
