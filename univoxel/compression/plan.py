"""How much model a scene needs: what is chosen, when, and how large its file may be.

No grid is finer than the photographs. Capacity that adapts chooses more: after the coarse stage,
by rehearsals of the next, the voxels of a dense grid; after the first stage with light its
channels, lobes and hidden units; at the end how far from the surface nodes are stored, and which
rows of a hash table.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from univoxel.camera import Cameras
from univoxel.checkpoint import SHELL, stored
from univoxel.compression import search
from univoxel.compression.quality import TOLERANCE, Choice, Look, smallest
from univoxel.config import TrainConfig
from univoxel.fields.dense import DenseDistances
from univoxel.fields.features import FEWEST_ROWS, PER_LEVEL, ROWS, NodeFeatures
from univoxel.grid import fit_grid
from univoxel.lights import LocalSG
from univoxel.networks import DirectionTable
from univoxel.scene import Scene, SceneConfig
from univoxel.training.config import StageConfig

REGAINED = 0.1  # dB that channels may cost where training goes on with what is left
GRID_TOLERANCE = 0.1  # dB that a rehearsal on a coarser grid may fall short of the best so far
STRIDE, STEP = 1 / 9, 1 / 3  # voxels of a grid over those of the next finer that is tried
FEWEST_VOXELS = 16**3
REHEARSAL = 0.05  # share of a stage's steps that a grid is tried for; of the chosen one they count
FEWEST_STEPS = 8  # of a rehearsal: fewer tell nothing
LESSON = 1024  # rays of the training photographs that heads settle on
REACH_TOLERANCE = 0.05  # dB that nodes far from the surface may be worth and are not stored
PROBE, PROBES = 4096, 8  # rays that tell what rows of a table are worth, and how often so many
REACHES = (3.5, 3.0, 2.75, 2.5, 2.25, 2.0, 1.75, 1.5, 1.25, 1.0)  # voxels
ROW_BYTES = 4 + 2 * PER_LEVEL  # of a row of a hash table: its number, and features in halves
MIRROR_SHARE = 0.1  # of a budget, that the table of mirrored directions may have
HEADER, NAME = 8192, 64  # bytes of a model's file that hold no numbers, and of a view's name


def coarser_grid(
    scene: Scene,
    most: int,
    box: tuple[Tensor, Tensor],
    rehearse: Callable[[Scene], float],
) -> Choice:
    """Bring the field to the coarsest grid that a rehearsal of the next stage draws as well with.

    Tries grids with STRIDE of each other's voxels, all of them: rehearsals are too short to err
    evenly, and coarse grids cost little. The coarsest that ends no more than GRID_TOLERANCE below
    the best is taken, or one with STEP of its voxels, if that does too. Every rehearsal begins from
    the scene as it is; the scene goes on from the one on its grid.

    Args:
        most: voxels of the finest grid.
        box: corners [3], [3].
        rehearse: trains a scene and returns the PSNR of its held-out rays.
    """
    scene.surface_moved()
    found: dict[int, float] = {}
    chosen, kept = most, scene

    def enough(voxels: int) -> bool:
        return found[voxels] >= max(found.values()) - GRID_TOLERANCE

    def attempt(voxels: int) -> None:
        nonlocal chosen, kept
        tried = copy.deepcopy(scene)
        tried.field = tried.field.resized(fit_grid(*box, voxels))
        found[voxels] = rehearse(tried)
        if enough(voxels):
            chosen, kept = voxels, tried

    strides = range(1 + int(math.log(max(most / FEWEST_VOXELS, 1), 1 / STRIDE)))
    for k in strides:
        attempt(round(most * STRIDE**k))
    if (coarser := round(chosen * STEP)) >= FEWEST_VOXELS:
        attempt(coarser)
    copy_over(kept, scene)
    why = "held-out rays after rehearsals: "
    why += ", ".join(f"{v:,} {found[v]:.2f} dB" for v in sorted(found, reverse=True))
    return Choice("voxels", most, chosen, max(found.values()) - found[chosen], why)


def copy_over(source: Scene, target: Scene) -> None:
    """Let target be what source is."""
    target.field, target.inv_s = source.field, source.inv_s
    target.load_state_dict(source.state_dict())
    target.surface_moved()


def shorter_reach(scene: Scene, look: Look, limit: float = REACH_TOLERANCE) -> Choice:
    """How far from the surface a finished scene is stored, in voxels."""
    with torch.no_grad():
        before = look.decode(scene, surface := look.meet(scene), surface.features)
    costs = {SHELL: 0.0}

    def cost(reach: float) -> float:
        costs[reach] = paid(scene, look, before, reach)
        return costs[reach]

    reach = smallest([SHELL, *REACHES], cost, limit)
    nodes = scene.field.sdf.detach().abs() / scene.field.voxel_size
    kept, all_kept = int((nodes < reach).sum()), int((nodes < SHELL).sum())
    why = (
        f"{kept:,} of {nodes.numel():,} nodes are stored instead of {all_kept:,}; "
        f"costs {costs[reach]:.3f} dB"
    )
    return Choice("reach", SHELL, reach, costs[reach], why)


@torch.no_grad()
def paid(scene: Scene, look: Look, before: dict[str, Tensor], reach: float | None) -> float:
    """dB that a scene loses against `before` when it is stored only so many voxels far; None: when
    it is stored as it is."""
    field = scene.field
    sdf, features = field.sdf.data, field.features.data
    far = math.inf if reach is None else reach * field.voxel_size
    try:
        read = field.rows_near(far).view(*features.shape[:-1], 1)
        field.sdf.data = torch.where(sdf.abs() < far, sdf, SHELL * field.voxel_size * sdf.sign())
        field.features.data = features * read
        surface = look.meet(scene)
        return look.cost(before, look.decode(scene, surface, surface.features))
    finally:
        field.sdf.data, field.features.data = sdf, features


def adapt(
    scene: Scene,
    cfg: TrainConfig,
    index: int,
    box: tuple[Tensor, Tensor],
    look: Look,
    lesson: Callable[[int], Look],
    rehearse: Callable[[Scene, StageConfig, int], float],
    pace: float = 1.0,
) -> list[Choice]:
    """Fit what comes after stage `index` to the scene, in place; what was chosen, in order.

    Args:
        box: corners [3], [3] of the grid.
        look: the held-out rays.
        lesson: draws so many of those that are trained on.
        rehearse: trains a scene in a stage's manner in so many steps and returns the PSNR of its
            held-out rays.
        pace: share of its steps that time let the last stage make.
    """
    found: list[Choice] = []
    stage, after = cfg.stages[index], cfg.stages[index + 1 :]
    follows = after[0] if after else None
    if isinstance(follows, StageConfig) and not follows.refit:
        most = limit = round(1e6 * follows.voxels)
        steps = max(FEWEST_STEPS, round(REHEARSAL * pace * follows.iterations))
        if cfg.budget_mb:
            most = min(most, affordable(scene, 1e6 * cfg.budget_mb))

        def rehearsed(tried: Scene) -> float:
            return rehearse(tried, on_grid(follows, box, tried.field.voxel_size), steps)

        room = f"the budget leaves room for {most:,}"
        if isinstance(scene.field.encoding, NodeFeatures):
            choice = coarser_grid(scene, most, box, rehearsed)
            if most < limit:
                choice = replace(choice, before=limit, why=f"{room}; {choice.why}")
            found.append(choice)
        elif most < limit:
            # Only then: a node is one number there, and a coarser grid costs more than it saves
            found.append(Choice("voxels", limit, most, 0.0, room))
    if isinstance(stage, StageConfig) and not stage.refit and stage.physical_from < 1:
        tolerance, taught = REGAINED if after else TOLERANCE, lesson(LESSON)
        if isinstance(scene.field.encoding, NodeFeatures):
            found.append(search.fewer_channels(scene, look, taught, tolerance))
        if scene.cfg.mirror_levels:
            found.append(search.fewer_mirror_levels(scene, look, taught))
        if search.share_of_heads(scene) > search.WORTH:
            if isinstance(scene.light, LocalSG):
                found.append(search.fewer_lobes(scene, look, taught))
            found.append(search.fewer_units(scene, look, taught))
    if not after:
        if isinstance(scene.field.distances, DenseDistances):
            found.append(shorter_reach(scene, look))
        if not isinstance(scene.field.encoding, NodeFeatures):
            far = (reach([c.noted() for c in found]) or SHELL) * scene.field.voxel_size
            found.append(
                search.fewer_rows(scene, look, (lesson(PROBE) for _ in range(PROBES)), far)
            )
        if cfg.budget_mb:
            found += within(scene, look, reach([c.noted() for c in found]), 1e6 * cfg.budget_mb)
    return found


def check_budget(scene: Scene, megabytes: float) -> None:
    """Refuse a budget that the networks and the map as they are, and the coarsest grid with half of
    its nodes near the surface, do not fit into.

    Raises:
        ValueError: says how much is needed.
    """
    least = _apart_from_grid(scene) + FEWEST_VOXELS // 2 * _node_bytes(scene)
    if 1e6 * megabytes < least:
        raise ValueError(
            f"--budget-mb: {megabytes:g} is too small for anything: networks, map and the coarsest "
            f"grid need {least / 1e6:.2g}"
        )


def within(scene: Scene, look: Look, reach: float | None, budget: float) -> list[Choice]:
    """Bring a finished scene into a file of `budget` bytes, whatever that costs: first less far
    from the surface, then on a coarser grid.

    Args:
        reach: voxels from the surface that nodes are stored; None: bricks are, as they are.
    """

    def size(reach: float | None) -> int:
        tensors = stored(scene, slim=True, reach=reach).values()
        names = NAME * len(scene.cfg.views)
        return HEADER + names + sum(x.numel() * x.element_size() for x in tensors)

    if size(reach) <= budget:
        return []
    with torch.no_grad():
        before = look.decode(scene, surface := look.meet(scene), surface.features)
    least = reach
    if reach is not None:
        shorter = [r for r in REACHES if r < reach]
        least = next((r for r in shorter if size(r) <= budget), REACHES[-1])
    nodes = count = scene.field.grid.nodes_count
    while size(least) > budget and count > FEWEST_VOXELS:
        count = round(0.8 * count)
        scene.field = scene.field.resized(fit_grid(*scene.field.bounds(), count))
    scene.surface_moved()
    cost, found = paid(scene, look, before, least), []
    if reach is not None and least is not None:
        found.append(Choice("reach", reach, least, cost, "for the budget"))
    if count < nodes:
        found.append(Choice("voxels", nodes, count, cost, "for the budget"))
    return found


def affordable(scene: Scene, budget: float) -> int:
    """Voxels of the finest grid on which the scene's surface fits into a file of `budget` bytes.

    The nodes near a surface are as many as its area has squares of a voxel's side.
    """
    near = _node_bytes(scene) * search.nodes_near(scene)
    room = max(budget - _apart_from_grid(scene), 0.0)
    return max(FEWEST_VOXELS, int(scene.field.grid.nodes_count * (room / near) ** 1.5))


def table_rows(scene: SceneConfig, budget_mb: float | None) -> int:
    """Rows of a level's hash table: as many as half of the budget has room for, if there is one."""
    if budget_mb is None:
        return ROWS
    room = 0.5e6 * budget_mb / (scene.channels // PER_LEVEL * ROW_BYTES)
    return min(max(2 ** int(math.log2(max(room, 1.0))), FEWEST_ROWS), ROWS)


def mirror_levels(scene: SceneConfig, budget_mb: float | None) -> int:
    """Levels of the table of mirrored directions: as many as a share of the budget has room for."""
    if budget_mb is None:
        return scene.mirror_levels
    levels = range(scene.mirror_levels + 1)
    return max(n for n in levels if _direction_bytes(n) <= MIRROR_SHARE * 1e6 * budget_mb)


def _direction_bytes(levels: int) -> int:
    return ROW_BYTES * sum(DirectionTable.rows_used(k) for k in range(levels))


def _node_bytes(scene: Scene) -> int:
    """Of a node near the surface: number of its row and distance, in halves; and, where features
    are of nodes, its number again and features."""
    features = 4 + 2 * scene.cfg.channels if isinstance(scene.field.encoding, NodeFeatures) else 0
    return 4 + 2 + features


def _apart_from_grid(scene: Scene) -> int:
    rest = (x for name, x in scene.state_dict().items() if not name.startswith(search.TABLES))
    names = NAME * len(scene.cfg.views)
    rows = 0 if isinstance(scene.field.encoding, NodeFeatures) else len(scene.field.features)
    rows_bytes = ROW_BYTES * rows + _direction_bytes(scene.cfg.mirror_levels)
    return HEADER + names + rows_bytes + sum(x.numel() * x.element_size() for x in rest)


def on_grid(stage: StageConfig, box: tuple[Tensor, Tensor], voxel_size: float) -> StageConfig:
    """A stage with its sharpness, which counts in voxels of its own grid, for those of another.

    Edges stay as sharp in the world as on the finest grid: what a coarse grid cannot say is bends
    of the surface, not the place of an edge.
    """
    own = fit_grid(*box, round(1e6 * stage.voxels)).voxel_size
    begin, end = (s * min(own / voxel_size, 1.0) for s in stage.sharpness)
    return replace(stage, sharpness=(begin, end))


def within_pixels(cfg: TrainConfig, cameras: Cameras, box: tuple[Tensor, Tensor]) -> TrainConfig:
    """The same with no grid finer than the photographs are: voxels of cfg.voxel_pixels pixels or
    more, as half of the cameras see them at the middle of the box."""
    if not cfg.voxel_pixels:
        return cfg
    lower, upper = box
    away = (cameras.camera_to_world[:, :, 3] - (lower + upper) / 2).norm(dim=1)
    pixel = float((away / cameras.focal.mean(1)).median())
    most = float((upper - lower).prod()) / (cfg.voxel_pixels * pixel) ** 3
    most = max(most, FEWEST_VOXELS) / 1e6
    stages = (
        replace(s, voxels=min(s.voxels, most)) if isinstance(s, StageConfig) else s
        for s in cfg.stages
    )
    return replace(cfg, stages=tuple(stages))


def voxels(stage: StageConfig, chosen: list[dict]) -> int:
    """Of a stage's grid: its own, or fewer where that was chosen."""
    fewer = [round(c["after"]) for c in chosen if c["what"] == "voxels"]
    return min([round(1e6 * stage.voxels), *fewer])


def rehearsed(scene: Scene, choices: list[Choice]) -> bool:
    """Whether the coming stage has made its first steps in a rehearsal."""
    by_node = isinstance(scene.field.encoding, NodeFeatures)
    return by_node and any(c.what == "voxels" for c in choices)


def reach(chosen: list[dict]) -> float | None:
    """What `shorter_reach` chose, if it did."""
    found = [c["after"] for c in chosen if c["what"] == "reach"]
    return found[-1] if found else None
