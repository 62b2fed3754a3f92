"""What of a finished scene its file stores: nodes near the surface, on a grid that fits."""

from __future__ import annotations

import math

import torch

from univoxel.checkpoint import SHELL
from univoxel.compression.choices import CapacityChoice
from univoxel.compression.config import CompressionConfig
from univoxel.compression.quality import Decoded, ReferenceRays, last_within_limit
from univoxel.compression.sizes import file_bytes
from univoxel.grid import fit_grid
from univoxel.scene import Scene


def shortest_reach(scene: Scene, held_out: ReferenceRays, cfg: CompressionConfig) -> CapacityChoice:
    """The least distance from the surface, in voxels, up to which nodes must be stored."""
    before = held_out.decoded(scene)
    losses = {SHELL: 0.0}

    def loss_db(reach: float) -> float:
        losses[reach] = storage_loss_db(scene, held_out, before, reach)
        return losses[reach]

    reach = last_within_limit([SHELL, *cfg.reaches], loss_db, cfg.reach_tolerance_db)
    voxels = scene.field.sdf.detach().abs() / scene.field.voxel_size
    stored_nodes, shell_nodes = int((voxels < reach).sum()), int((voxels < SHELL).sum())
    why = (
        f"{stored_nodes:,} of {voxels.numel():,} nodes are stored instead of {shell_nodes:,}; "
        f"costs {losses[reach]:.3f} dB"
    )
    return CapacityChoice("reach", SHELL, reach, losses[reach], why)


@torch.no_grad()
def storage_loss_db(
    scene: Scene, held_out: ReferenceRays, before: Decoded, reach: float | None
) -> float:
    """Quality that a scene loses against `before` by what its file leaves out.

    Args:
        reach: voxels from the surface up to which nodes are stored; None: all are.
    """
    field = scene.field
    sdf, features = field.sdf.data, field.features.data
    far = math.inf if reach is None else reach * field.voxel_size
    with scene.surface_held():  # only far nodes change, and they come back
        try:
            near = field.rows_near(far).view(*features.shape[:-1], 1)
            field.sdf.data = torch.where(
                sdf.abs() < far, sdf, SHELL * field.voxel_size * sdf.sign()
            )
            field.features.data = features * near
            return held_out.loss_db(before, held_out.decoded(scene))
        finally:
            field.sdf.data, field.features.data = sdf, features


def fit_budget_(
    scene: Scene,
    held_out: ReferenceRays,
    reach: float | None,
    budget_bytes: float,
    cfg: CompressionConfig,
) -> list[CapacityChoice]:
    """Bring a finished scene into a file of that size, whatever it costs, and say what was chosen.

    First fewer nodes far from the surface are stored, then the grid becomes coarser.

    Args:
        reach: voxels from the surface up to which nodes are stored; None: all bricks are.
    """
    if file_bytes(scene, reach) <= budget_bytes:
        return []
    before = held_out.decoded(scene)
    new_reach = reach
    if reach is not None:
        shorter = (r for r in cfg.reaches if r < reach and file_bytes(scene, r) <= budget_bytes)
        new_reach = next(shorter, cfg.reaches[-1])
    nodes = count = scene.field.grid.nodes_count
    while file_bytes(scene, new_reach) > budget_bytes and count > cfg.fewest_voxels:
        count = round(cfg.budget_step * count)
        scene.field = scene.field.resized(fit_grid(*scene.field.bounds(), count))
    cost = storage_loss_db(scene, held_out, before, new_reach)
    choices = []
    if reach is not None and new_reach is not None:
        choices.append(CapacityChoice("reach", reach, new_reach, cost, "for the budget"))
    if count < nodes:
        choices.append(CapacityChoice("voxels", nodes, count, cost, "for the budget"))
    return choices
