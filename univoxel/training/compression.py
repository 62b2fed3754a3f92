"""Compression of a scene: the choice of sizes, their cost in quality, and compact storage."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from univoxel.camera import Cameras, pixel_width
from univoxel.color import linear_to_srgb
from univoxel.config import StageConfig, TrainConfig
from univoxel.core.records import Rays, Surface
from univoxel.data import Photos
from univoxel.errors import UserError
from univoxel.fields.distances import DenseDistances
from univoxel.fields.field import FEWEST_ROWS, PER_LEVEL, ROWS, NodeField
from univoxel.fields.grid import fit_grid
from univoxel.ops.networks import MLP, DirectionTable
from univoxel.render.pipeline import radiance_of, shade, surface_at
from univoxel.scene import SHELL, Scene, SceneConfig, stored
from univoxel.training.loop import batch_at
from univoxel.training.pixels import TrainingPixels
from univoxel.training.progress import CapacityChoice, chosen_reach, chosen_voxels

# How small reflected directions and hash tables may be: quality lost, and the search for sizes.
#
# Quality is lost in dB: how much less well validation pixels are drawn with a smaller model, by the
# physically based render and by the radiance head; or how far materials move, as if that were an
# error of the same render.


# dB that mirror levels, and rows, may cost. Below what is visible, even both together
TOLERANCE_DB = 0.02
# Shares of a hash table's rows that are dropped on trial, from 0 rising. Finer where more is gone,
# as costs rise faster there
DROPPED_ROW_SHARES = (
    *(0.0, 1 / 4, 3 / 8, 1 / 2, 5 / 8, 11 / 16, 3 / 4, 13 / 16, 7 / 8, 29 / 32, 15 / 16),
)

Number = TypeVar("Number", int, float)


class Decoded(NamedTuple):
    """Everything that a scene's networks give along N rays, times opacity."""

    radiance: Tensor  # [N, 3] of the radiance head, sRGB
    physical: Tensor  # [N, 3] physically based render, sRGB
    material: Tensor  # [N, 5] albedo, roughness, metallic


@dataclass(frozen=True)
class ReferenceRays:
    """N rays and the colours that the photographs show there.

    Held-out rays judge what is lost; rays of the training photographs probe.
    """

    rays: Rays
    view: Tensor  # [N] int64
    target: Tensor  # [N, 3] sRGB, on black

    @property
    def wo(self) -> Tensor:
        return -self.rays.direction

    def surface(self, scene: Scene) -> Surface:
        """The surface that the rays meet; no gradient."""
        with torch.no_grad():
            return surface_at(scene, self.rays)

    def decode(self, scene: Scene, surface: Surface, features: Tensor) -> Decoded:
        """What the networks make of features [N, C] on a surface."""
        opacity = surface.opacity[:, None]
        albedo, roughness, metallic = scene.material(features)
        surface = replace(
            surface, features=features, albedo=albedo, roughness=roughness, metallic=metallic
        )
        radiance = radiance_of(scene, surface, self.wo, self.view)
        physical = shade(scene, surface, self.wo, view=self.view)
        material = torch.cat([albedo, roughness[:, None], metallic[:, None]], 1)
        return Decoded(
            radiance * opacity,
            linear_to_srgb((physical * opacity).clamp_min(0)),
            material * opacity,
        )

    @torch.no_grad()
    def decoded(self, scene: Scene) -> Decoded:
        """What the scene as it is gives along the rays; no gradient."""
        surface = self.surface(scene)
        return self.decode(scene, surface, surface.features)

    def loss_db(self, before: Decoded, after: Decoded) -> float:
        """Quality that was lost: the largest loss of radiance, physical render and materials."""

        def error(picture: Tensor) -> Tensor:
            return (picture - self.target).square().mean()

        moved = (after.material - before.material).square().mean()
        ratio = [
            error(after.radiance) / error(before.radiance),
            error(after.physical) / error(before.physical),
            1 + moved / error(before.physical),
        ]
        return 10 * torch.stack(ratio).max().log10().item()


def reference_rays(photos: Photos, pixels: Tensor) -> ReferenceRays:
    """The rays of pixels [P, 3] (view, row, column) of the photographs."""
    batch = batch_at(photos, pixels)
    target = linear_to_srgb(batch.color * batch.alpha[:, None])
    return ReferenceRays(batch.rays, batch.view, target)


def last_within_limit(
    candidates: Sequence[Number], loss_db: Callable[[Number], float], limit_db: float
) -> Number:
    """The last candidate that loses at most `limit_db`, found by bisection.

    Args:
        candidates: the first costs nothing and is not measured; losses rise from one to the next.
    """
    low, high = 0, len(candidates)
    while high - low > 1:
        middle = (low + high) // 2
        if loss_db(candidates[middle]) <= limit_db:
            low = middle
        else:
            high = middle
    return candidates[low]


def fewer_mirror_levels_(scene: Scene, held_out: ReferenceRays) -> CapacityChoice:
    """Drop the finest levels of the table of mirrored directions that held-out rays do not miss."""
    surface = held_out.surface(scene)
    full = scene.cfg.mirror_levels
    states = {full: _mirror_state(scene)}
    losses = {full: 0.0}

    @torch.no_grad()
    def decoded() -> Decoded:
        return held_out.decode(scene, surface, surface.features)

    before = decoded()

    def loss_db(levels: int) -> float:
        drop_mirror_levels_(scene, levels)
        losses[levels] = held_out.loss_db(before, decoded())
        states[levels] = _mirror_state(scene)
        _restore_(states[full])
        return losses[levels]

    levels = last_within_limit(range(full, -1, -1), loss_db, TOLERANCE_DB)
    _restore_(states[levels])
    why = f"costs {losses[levels]:.3f} dB"
    if fewer := [n for n in losses if n < levels]:
        why += f", but {max(fewer)} levels would cost {losses[max(fewer)]:.3f} dB"
    return CapacityChoice("mirror levels", full, levels, losses[levels], why)


def drop_mirror_levels_(scene: Scene, levels: int) -> None:
    """Keep the coarsest levels of the table of mirrored directions; of the others the networks that
    read it see 0 from now on. Networks and table are new: the old stay as they were."""
    table = scene.radiance.directions
    dropped = table.channels - table.per_level * levels
    for owner in (scene.radiance, scene.mirrored):
        if owner is not None:
            owner.net = _without_last_inputs(owner.net, dropped)
    table.table = nn.Parameter(table.table.data[: levels * table.rows].clone())
    scene.cfg = replace(scene.cfg, mirror_levels=levels)


def _without_last_inputs(net: MLP, dropped: int) -> MLP:
    weights = [layer.weight.data for layer in net.linear]
    weights[0] = weights[0][:, : weights[0].shape[1] - dropped]
    fewer = MLP([weights[0].shape[1], *(len(w) for w in weights)])
    for layer, weight, before in zip(fewer.linear, weights, net.linear, strict=True):
        layer.weight = nn.Parameter(weight.clone())
        layer.bias = nn.Parameter(before.bias.data.clone())
    return fewer


def _mirror_state(scene: Scene) -> list[tuple[Any, str, Any]]:
    """Owner, name and value of all that `drop_mirror_levels_` replaces."""
    names = [(scene, "cfg"), (scene.radiance, "net"), (scene.radiance.directions, "table")]
    if scene.mirrored is not None:
        names.append((scene.mirrored, "net"))
    return [(owner, name, getattr(owner, name)) for owner, name in names]


def _restore_(state: list[tuple[Any, str, Any]]) -> None:
    for owner, name, value in state:
        setattr(owner, name, value)


def fewer_rows_(
    scene: Scene,
    held_out: ReferenceRays,
    probes: Iterable[ReferenceRays],
    far: float,
    limit_db: float,
) -> CapacityChoice:
    """Set the rows of a hash table to 0, which a file does not hold, that matter least.

    A row matters, to first order, by its features times the gradient of everything that is
    decoded. Rows that no probe meets are not judged, and stay.

    Args:
        probes: rays of the training photographs, a batch at a time.
        far: world units from the surface, beyond which rows are not looked at.

    Source: as LeCun et al. 1990, "Optimal Brain Damage", with squared gradients for the Hessian.
    """
    features = scene.field.features
    all_features = features.detach().clone()
    stored_rows = all_features.any(1) & scene.field.rows_near(far)
    squared = torch.zeros_like(all_features)
    judged = torch.zeros_like(stored_rows)
    for probe in probes:
        rows, slope = _row_gradients(scene, probe)
        squared[rows] += slope.square()
        judged[rows] = True
    worth = (squared * all_features.square()).sum(1)
    order = (stored_rows & judged).nonzero()[:, 0]
    order = order[worth[order].argsort()]
    decoded_before = held_out.decoded(scene)
    losses = {0.0: 0.0}

    @torch.no_grad()
    def drop_(share: float) -> None:
        features.copy_(all_features)
        features[order[: round(share * len(order))]] = 0

    def loss_db(share: float) -> float:
        drop_(share)
        losses[share] = held_out.loss_db(decoded_before, held_out.decoded(scene))
        return losses[share]

    share = last_within_limit(DROPPED_ROW_SHARES, loss_db, limit_db)
    drop_(share)
    count = int(stored_rows.sum())
    kept, why = count - round(share * len(order)), f"costs {losses[share]:.3f} dB"
    return CapacityChoice("rows", count, kept, losses[share], why)


def _row_gradients(scene: Scene, probe: ReferenceRays) -> tuple[Tensor, Tensor]:
    """Rows [K] of the features that rays read, and the gradient [K, F] of a random mixture of
    everything that is decoded; its square is on average the sum of all outputs' squares."""
    surface = surface_at(scene, probe.rays)
    outputs = probe.decode(scene, surface, surface.features)
    mixed = [(x * (torch.randint_like(x, 2) * 2 - 1)).sum() for x in outputs]
    (slope,) = torch.autograd.grad(torch.stack(mixed).sum(), scene.field.features)
    slope = slope.coalesce()
    return slope._indices()[0], slope._values()


# What of a finished scene its file stores, its bytes, and what of them fits into a budget.


# Voxels of the coarsest grid. 16^3: below, no object keeps its parts
FEWEST_VOXELS = 16**3
# dB that leaving out nodes far from the surface may cost
REACH_TOLERANCE_DB = 0.05
# Distances from the surface, voxels, up to which nodes are stored: falling; the first that is tried
# is SHELL. Below 1 the surface's own cells lose nodes
REACHES = (3.5, 3.0, 2.75, 2.5, 2.25, 2.0, 1.75, 1.5, 1.25, 1.0)
# Share of the budget that bounds the rows of the hash table: the grid needs the rest
TABLE_SHARE = 0.5
# Share of the budget that the table of reflected directions may have: it matters for gloss only
MIRROR_SHARE = 0.1
# Nodes of the next grid over those of the last, until a finished scene fits the budget. Each try
# loses detail: small steps come closest to the budget
BUDGET_STEP = 0.8
TABLES = ("field.", "radiance.directions.")  # names of parameters that begin so are no network's
# Of the file: format, not chosen
ROW_BYTES = 4 + 2 * PER_LEVEL  # of a row of a hash table: its number, and features in halves
HEADER_BYTES = 8192  # of a file, that hold no numbers
NAME_BYTES = 64  # of a view's name


def file_bytes(scene: Scene, reach: float | None) -> int:
    """Size of the finished scene's file, rounded up.

    Args:
        reach: voxels from the surface up to which nodes are stored; None: all bricks are.
    """
    tensors = stored(scene, slim=True, reach=reach).values()
    names = NAME_BYTES * len(scene.cfg.views)
    return HEADER_BYTES + names + sum(x.numel() * x.element_size() for x in tensors)


def check_budget(scene: Scene, budget_mb: float) -> None:
    """Refuse a budget that the networks and the map as they are, and the coarsest grid with half of
    its nodes near the surface, do not fit into.

    Raises:
        UserError: says how much is needed.
    """
    least = _bytes_apart_from_grid(scene) + FEWEST_VOXELS // 2 * _node_bytes(scene)
    if 1e6 * budget_mb < least:
        raise UserError(
            f"budget_mb must be at least {least / 1e6:.2g} to hold the networks, the environment "
            f"map and the coarsest grid, got {budget_mb:g}",
            "budget_mb",
        )


def voxels_that_fit(scene: Scene, budget_bytes: float) -> int:
    """Voxels of the finest grid on which the scene's surface fits into a file of that size.

    The nodes near a surface are as many as its area has squares of a voxel's side.
    """
    near = int((scene.field.sdf.detach().abs() < SHELL * scene.field.voxel_size).sum())
    near *= _node_bytes(scene)
    room = max(budget_bytes - _bytes_apart_from_grid(scene), 0.0)
    return max(FEWEST_VOXELS, int(scene.field.grid.nodes_count * (room / near) ** 1.5))


def table_rows(scene: SceneConfig, budget_mb: float | None) -> int:
    """Rows of a level's hash table: as many as its share of the budget has room for."""
    if budget_mb is None:
        return ROWS
    room = TABLE_SHARE * 1e6 * budget_mb / (scene.channels // PER_LEVEL * ROW_BYTES)
    return min(max(2 ** int(math.log2(max(room, 1.0))), FEWEST_ROWS), ROWS)


def mirror_levels(scene: SceneConfig, budget_mb: float | None) -> int:
    """Levels of the table of reflected directions: as many as its share of the budget has room
    for."""
    if budget_mb is None:
        return scene.mirror_levels
    levels = range(scene.mirror_levels + 1)
    return max(n for n in levels if _direction_bytes(n) <= MIRROR_SHARE * 1e6 * budget_mb)


def _direction_bytes(levels: int) -> int:
    return ROW_BYTES * sum(DirectionTable.rows_used(k) for k in range(levels))


def _node_bytes(scene: Scene) -> int:
    """Of a node near the surface: number of its row and distance, in halves; and, where features
    are of nodes, its number again and features."""
    features = 4 + 2 * scene.cfg.channels if isinstance(scene.field, NodeField) else 0
    return 4 + 2 + features


def _bytes_apart_from_grid(scene: Scene) -> int:
    rest = (x for name, x in scene.state_dict().items() if not name.startswith(TABLES))
    names = NAME_BYTES * len(scene.cfg.views)
    rows = 0 if isinstance(scene.field, NodeField) else len(scene.field.features)
    rows_bytes = ROW_BYTES * rows + _direction_bytes(scene.cfg.mirror_levels)
    return HEADER_BYTES + names + rows_bytes + sum(x.numel() * x.element_size() for x in rest)


def shortest_reach(scene: Scene, held_out: ReferenceRays) -> CapacityChoice:
    """The least distance from the surface, in voxels, up to which nodes must be stored."""
    before = held_out.decoded(scene)
    losses = {SHELL: 0.0}

    def loss_db(reach: float) -> float:
        losses[reach] = storage_loss_db(scene, held_out, before, reach)
        return losses[reach]

    reach = last_within_limit([SHELL, *REACHES], loss_db, REACH_TOLERANCE_DB)
    voxels = scene.field.sdf.detach().abs() / scene.field.voxel_size
    stored_nodes, shell_nodes = int((voxels < reach).sum()), int((voxels < SHELL).sum())
    why = (
        f"{stored_nodes:,} of {voxels.numel():,} nodes are stored instead of {shell_nodes:,}, "
        f"which costs {losses[reach]:.3f} dB"
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
    scene: Scene, held_out: ReferenceRays, reach: float | None, budget_bytes: float
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
        shorter = (r for r in REACHES if r < reach and file_bytes(scene, r) <= budget_bytes)
        new_reach = next(shorter, REACHES[-1])
    nodes = count = scene.field.grid.nodes_count
    while file_bytes(scene, new_reach) > budget_bytes and count > FEWEST_VOXELS:
        count = round(BUDGET_STEP * count)
        scene.field = scene.field.resized(fit_grid(*scene.field.bounds(), count))
    cost = storage_loss_db(scene, held_out, before, new_reach)
    choices = []
    if reach is not None and new_reach is not None:
        choices.append(CapacityChoice("reach", reach, new_reach, cost, "for the budget"))
    if count < nodes:
        choices.append(CapacityChoice("voxels", nodes, count, cost, "for the budget"))
    return choices


# What is chosen when, so that a model is no larger than its scene needs.
#
# No grid is finer than the photographs, and no finer than the budget has room for. Capacity that
# adapts chooses more: after the first stage with light the levels of the table of mirrored
# directions; at the end how far from the surface nodes are stored, and which rows of a hash table.


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
            choices.append(fewer_mirror_levels_(scene, held_out))
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
    return [CapacityChoice("voxels", limit, most, 0.0, f"the budget has room for {most:,} voxels")]


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
    if not isinstance(scene.field, NodeField):
        far = (chosen_reach(choices) or SHELL) * scene.field.voxel_size
        probes = (  # drawn one by one: each is dropped before the next is
            reference_rays(photos, pixels[torch.randperm(len(pixels))[:ROW_PROBE_RAYS]])
            for _ in range(ROW_PROBES)
        )
        choices.append(fewer_rows_(scene, held_out, probes, far, TOLERANCE_DB))
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
