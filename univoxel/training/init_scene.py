"""The scene that training begins with."""

from __future__ import annotations

from dataclasses import replace

from univoxel import lights
from univoxel.config import StageConfig, TrainConfig
from univoxel.fields.features import PER_LEVEL, Levels
from univoxel.fields.field import Field, dense_field, hash_field
from univoxel.fields.grid import fit_grid
from univoxel.preparation.prepare import Prepared
from univoxel.scene import Scene
from univoxel.training import compression


def build_scene(prepared: Prepared, cfg: TrainConfig) -> Scene:
    """A scene whose surface is the carved hull, with poses and gains as far as they are known.

    Draws the first weights from torch's generator.

    Raises:
        UserError: cfg.budget_mb is too small for any such scene.
    """
    silhouettes, varying = prepared.silhouettes, prepared.varying
    lower, upper = silhouettes.box
    field = build_field(prepared, cfg)
    views = tuple(silhouettes.photos.names) if silhouettes.refined or varying != "none" else ()
    sized = replace(
        cfg.scene,
        light=lights.scaled(cfg.scene.light, float((upper - lower).max()) / 2),
        varying=varying,
        turntable=prepared.turntable,
        refined=silhouettes.refined,
        views=views,
        mirror_levels=compression.mirror_levels(cfg.scene, cfg.budget_mb),
    )
    scene = Scene(sized, field)
    if prepared.poses:
        scene.poses = prepared.poses
    if scene.views and prepared.gains is not None:
        scene.views.add(prepared.gains[:, None].expand(-1, 3))
    if cfg.budget_mb is not None:
        compression.check_budget(scene, cfg.budget_mb)
    return scene


def build_field(prepared: Prepared, cfg: TrainConfig) -> Field:
    """The field of the first stage, its surface that of the carved hull."""
    grid, hull, box = prepared.grid, prepared.hull, prepared.silhouettes.box
    stages = [s for s in cfg.stages if isinstance(s, StageConfig)]
    if stages[0].field != "hash":
        return dense_field(grid, cfg.scene.channels, hull)
    finest = min(fit_grid(*box, compression.stage_voxels(s, [])).voxel_size for s in stages)
    rows = compression.table_rows(cfg.scene, cfg.budget_mb)
    levels = Levels.of(grid.bounds(), finest, cfg.scene.channels // PER_LEVEL, rows)
    return hash_field(grid, levels, hull)
