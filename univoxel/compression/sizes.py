"""Parameters and bytes of the parts of a scene, and what of them fits into a budget."""

from __future__ import annotations

import math

from univoxel.checkpoint import SHELL, stored
from univoxel.compression.config import CompressionConfig
from univoxel.errors import UserError
from univoxel.fields.features import FEWEST_ROWS, PER_LEVEL, ROWS, NodeFeatures
from univoxel.networks import DirectionTable
from univoxel.scene import Scene, SceneConfig

TABLES = ("field.", "radiance.directions.")  # names of parameters that begin so are no network's
# Of the file: format, not chosen
ROW_BYTES = 4 + 2 * PER_LEVEL  # of a row of a hash table: its number, and features in halves
SKY_ROW_BYTES = 2 * 3 * 2  # of a map's texels, over its rows squared: halves
HEADER_BYTES = 8192  # of a file, that hold no numbers
NAME_BYTES = 64  # of a view's name


def nodes_near(scene: Scene) -> int:
    """Nodes of the grid within SHELL voxels of the surface."""
    return int((scene.field.sdf.detach().abs() < SHELL * scene.field.voxel_size).sum())


def head_share(scene: Scene) -> float:
    """Share that networks have of the parameters near the surface and of networks, in [0, 1]."""
    rest = sum(x.numel() for name, x in scene.named_parameters() if not name.startswith(TABLES))
    near = nodes_near(scene)
    features = near * scene.cfg.channels
    if not isinstance(scene.field.encoding, NodeFeatures):
        features = scene.field.features.shape[1] * int(scene.field.features.detach().any(1).sum())
    return rest / (rest + near + features)


def file_bytes(scene: Scene, reach: float | None) -> int:
    """Size of the finished scene's file, rounded up.

    Args:
        reach: voxels from the surface up to which nodes are stored; None: all bricks are.
    """
    tensors = stored(scene, slim=True, reach=reach).values()
    names = NAME_BYTES * len(scene.cfg.views)
    return HEADER_BYTES + names + sum(x.numel() * x.element_size() for x in tensors)


def check_budget(scene: Scene, budget_mb: float, cfg: CompressionConfig) -> None:
    """Refuse a budget that the networks and the map as they are, and the coarsest grid with half of
    its nodes near the surface, do not fit into.

    Raises:
        UserError: says how much is needed.
    """
    least = _bytes_apart_from_grid(scene) + cfg.fewest_voxels // 2 * _node_bytes(scene)
    if 1e6 * budget_mb < least:
        raise UserError(
            f"budget_mb: {budget_mb:g} is too small for anything: networks, map and the coarsest "
            f"grid need {least / 1e6:.2g}",
            "budget_mb",
        )


def voxels_that_fit(scene: Scene, budget_bytes: float, cfg: CompressionConfig) -> int:
    """Voxels of the finest grid on which the scene's surface fits into a file of that size.

    The nodes near a surface are as many as its area has squares of a voxel's side.
    """
    near = _node_bytes(scene) * nodes_near(scene)
    room = max(budget_bytes - _bytes_apart_from_grid(scene), 0.0)
    return max(cfg.fewest_voxels, int(scene.field.grid.nodes_count * (room / near) ** 1.5))


def table_rows(scene: SceneConfig, budget_mb: float | None, cfg: CompressionConfig) -> int:
    """Rows of a level's hash table: as many as its share of the budget has room for."""
    if budget_mb is None:
        return ROWS
    room = cfg.table_share * 1e6 * budget_mb / (scene.channels // PER_LEVEL * ROW_BYTES)
    return min(max(2 ** int(math.log2(max(room, 1.0))), FEWEST_ROWS), ROWS)


def mirror_levels(scene: SceneConfig, budget_mb: float | None, cfg: CompressionConfig) -> int:
    """Levels of the table of mirrored directions: as many as its share of the budget has room
    for."""
    if budget_mb is None:
        return scene.mirror_levels
    levels = range(scene.mirror_levels + 1)
    return max(n for n in levels if _direction_bytes(n) <= cfg.mirror_share * 1e6 * budget_mb)


def sky_rows(rows: int, budget_mb: float | None, cfg: CompressionConfig) -> int:
    """Rows of the map's texels: those, or as many as a share of the budget has room for; a multiple
    of 32."""
    if budget_mb is None:
        return rows
    room = math.isqrt(int(cfg.mirror_share * 1e6 * budget_mb / SKY_ROW_BYTES))
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
