"""What of a finished scene its file stores, its bytes, and what of them fits into a budget."""

from __future__ import annotations

import math

import torch

from univoxel.checkpoint import SHELL, stored
from univoxel.compression.search import Decoded, ReferenceRays, last_within_limit
from univoxel.errors import UserError
from univoxel.fields.features import FEWEST_ROWS, PER_LEVEL, ROWS, NodeFeatures
from univoxel.grid import fit_grid
from univoxel.networks import DirectionTable
from univoxel.scene import Scene, SceneConfig
from univoxel.training.choices import CapacityChoice

# Voxels of the coarsest grid. 16^3: below, no object keeps its parts
FEWEST_VOXELS = 16**3
# dB that leaving out nodes far from the surface may cost
REACH_TOLERANCE_DB = 0.05
# Distances from the surface, voxels, up to which nodes are stored: falling; the first that is tried
# is SHELL. Below 1 the surface's own cells lose nodes
REACHES = (3.5, 3.0, 2.75, 2.5, 2.25, 2.0, 1.75, 1.5, 1.25, 1.0)
# Share of the budget that bounds the rows of the hash table: the grid needs the rest
TABLE_SHARE = 0.5
# Share of the budget that the table of mirrored directions may have: it matters for gloss alone
MIRROR_SHARE = 0.1
# Nodes of the next grid over those of the last, until a finished scene fits the budget. Each try
# loses detail: small steps come closest to the budget
BUDGET_STEP = 0.8
TABLES = ("field.", "radiance.directions.")  # names of parameters that begin so are no network's
# Of the file: format, not chosen
ROW_BYTES = 4 + 2 * PER_LEVEL  # of a row of a hash table: its number, and features in halves
SKY_ROW_BYTES = 2 * 3 * 2  # of a map's texels, over its rows squared: halves
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
            f"budget_mb: {budget_mb:g} is too small for anything: networks, map and the coarsest "
            f"grid need {least / 1e6:.2g}",
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
    """Levels of the table of mirrored directions: as many as its share of the budget has room
    for."""
    if budget_mb is None:
        return scene.mirror_levels
    levels = range(scene.mirror_levels + 1)
    return max(n for n in levels if _direction_bytes(n) <= MIRROR_SHARE * 1e6 * budget_mb)


def sky_rows(rows: int, budget_mb: float | None) -> int:
    """Rows of the map's texels: those, or as many as a share of the budget has room for; a multiple
    of 32."""
    if budget_mb is None:
        return rows
    room = math.isqrt(int(MIRROR_SHARE * 1e6 * budget_mb / SKY_ROW_BYTES))
    return min(rows, room // 32 * 32)


def _direction_bytes(levels: int) -> int:
    return ROW_BYTES * sum(DirectionTable.rows_used(k) for k in range(levels))


def _node_bytes(scene: Scene) -> int:
    """Of a node near the surface: number of its row and distance, in halves; and, where features
    are of nodes, its number again and features."""
    features = 4 + 2 * scene.cfg.channels if isinstance(scene.field.encoding, NodeFeatures) else 0
    return 4 + 2 + features


def _bytes_apart_from_grid(scene: Scene) -> int:
    rest = (x for name, x in scene.state_dict().items() if not name.startswith(TABLES))
    names = NAME_BYTES * len(scene.cfg.views)
    rows = 0 if isinstance(scene.field.encoding, NodeFeatures) else len(scene.field.features)
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
