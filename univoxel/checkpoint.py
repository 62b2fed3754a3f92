"""The file of a scene: what it holds, and reading it back."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, astuple
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from univoxel.errors import DataError, FileError, MissingFile
from univoxel.fields.bricks import BrickDistances, pack_bricks, unpack_bricks
from univoxel.fields.dense import DenseDistances
from univoxel.fields.features import HashFeatures, Levels, NodeFeatures
from univoxel.fields.field import Field
from univoxel.fields.packing import PACKED, pack, unpack
from univoxel.grid import GridShape
from univoxel.lights import read_config
from univoxel.lights.turntable import Turntable
from univoxel.networks import DirectionTable
from univoxel.records import HALF_MAX, Bricks
from univoxel.scene import Scene, SceneConfig

FORMAT = 1  # of scene.safetensors; rises when older files cannot be read any more
FILE = "scene.safetensors"
# A file holds their rows that are not 0: parameter, and names of the numbers and values of rows
TABLES = {
    "field.features": ("field.feature_rows", "field.feature_values"),
    "radiance.directions.table": ("radiance.direction_rows", "radiance.direction_values"),
}
SHELL = 4.0  # voxels around the surface, beyond which a finished scene needs no features


def stored(scene: Scene, slim: bool = False, reach: float | None = None) -> dict[str, Tensor]:
    """The tensors of a scene's file, see `save_scene`."""
    tensors = {k: v.contiguous() for k, v in scene.state_dict().items() if k not in TABLES}
    sdf = scene.field.sdf.detach()
    if isinstance(bricks := scene.field.distances, BrickDistances):
        tensors |= {f"field.{k}": v for k, v in pack_bricks(bricks).items()}
        sdf = tensors["field.sdf"] = sdf[: Bricks.NODES * bricks.count]
    # Features that no sample has touched are 0: only the others are stored.
    features = scene.field.features.detach().flatten(0, -2)
    if isinstance(scene.field.encoding, NodeFeatures):
        features = features[: sdf.numel()]
    touched = features.any(1)
    if slim:
        shell = (reach or SHELL) * scene.field.voxel_size
        touched &= scene.field.rows_near(shell)[: len(features)]
        if reach is not None:
            packed = pack(tensors.pop("field.sdf"), shell)
            tensors |= {f"field.sdf_{name}": value for name, value in packed.items()}
    directions = scene.radiance.directions.table.detach()
    tables = (features, touched), (directions, directions.any(1))
    for (rows_name, values_name), (table, kept) in zip(TABLES.values(), tables, strict=True):
        rows = kept.nonzero()[:, 0]
        tensors[rows_name], tensors[values_name] = rows.int(), table[rows]
    if slim:
        # sdf next to the surface is a small number: half precision keeps it to 1e-3 voxels
        halves = {"field.sdf", "field.sdf_values", *(values for _, values in TABLES.values())}
        for name in halves & tensors.keys():
            tensors[name] = tensors[name].clamp(-HALF_MAX, HALF_MAX).half()
    return tensors


def save_scene(
    scene: Scene, run: Path, state: dict, slim: bool = False, reach: float | None = None
) -> Path:
    """Write run/scene.safetensors whole or not at all; `state` (JSON) travels in its metadata.

    Args:
        slim: for a scene that is done: the grids in half precision, and features only where rays
            meet the surface; otherwise what is loaded equals what was saved, bit by bit.
        reach: voxels from the surface, > 0, beyond which a slim file says of a node only on which
            side it lies; SHELL for features and no limit for distances when left out.

    Raises:
        FileError: names the file when it cannot be written; the one before stays.
    """
    tensors = stored(scene, slim, reach)
    meta = {
        "format": FORMAT,
        "scene": asdict(scene.cfg),
        "field": scene.field.kind,
        "grid": asdict(scene.field.grid),
        "inv_s": scene.inv_s,
        "state": state,
    }
    if isinstance(scene.field.encoding, HashFeatures):
        meta["levels"] = astuple(scene.field.encoding.levels)
    path = run / FILE
    temporary = path.with_suffix(".partial")
    try:
        save_file(tensors, temporary, {"univoxel": json.dumps(meta)})
        os.replace(temporary, path)
    except (OSError, SafetensorError) as error:
        temporary.unlink(missing_ok=True)
        raise FileError(f"{path}: cannot write the checkpoint: {error}") from error
    return path


def load_checkpoint(run: str | Path) -> tuple[Scene, dict]:
    """The scene of a run, in evaluation mode, and the state it was saved with.

    Raises:
        MissingFile: no checkpoint there.
        DataError: one that is cut short, damaged, or of another version.
    """
    path = Path(run) / FILE
    if not path.is_file():
        raise MissingFile(f"no checkpoint in {run} (looked for {FILE}); run `univoxel train` first")
    try:
        with safe_open(path, "pt") as file:
            meta = json.loads((file.metadata() or {}).get("univoxel", "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}
    except (SafetensorError, OSError, ValueError) as error:
        raise DataError(f"{path}: damaged or cut short: {error}") from error
    if meta.get("format") != FORMAT:
        raise DataError(
            f"{path}: expected checkpoint format {FORMAT}, got {meta.get('format')}; "
            "it was written by another version of univoxel"
        )
    try:
        light = read_config(meta["scene"].pop("light"))
        views = tuple(meta["scene"].pop("views", ()))
        turntable = meta["scene"].pop("turntable", None)
        if turntable is not None:
            turntable = Turntable(**{name: tuple(value) for name, value in turntable.items()})
        if "mirror_levels" not in meta["scene"]:  # a file from before there were any
            meta["scene"]["mirror_levels"] = 0
            none = torch.zeros(0, dtype=torch.int32), torch.zeros(0, DirectionTable.per_level)
            tensors |= zip(TABLES["radiance.directions.table"], none, strict=True)
        cfg = SceneConfig(**meta["scene"], light=light, views=views, turntable=turntable)
        grid = GridShape(
            tuple(meta["grid"]["origin"]), meta["grid"]["voxel_size"], tuple(meta["grid"]["size"])
        )
        kind = meta.get("field", "dense")
        if "field.place" in tensors:
            where = tensors.pop("field.place"), tensors.pop("field.inside")
            distances = BrickDistances(grid, unpack_bricks(*where, grid.size))
        else:
            distances = DenseDistances(grid)
        if kind == "hash":
            lower, upper, sizes, *rows = meta["levels"]
            encoding = HashFeatures(Levels(tuple(lower), tuple(upper), tuple(sizes), *rows))
        else:
            encoding = NodeFeatures(torch.zeros(*distances.sdf.shape, cfg.channels))
        field = Field(distances, encoding)
        if field.channels != cfg.channels:
            raise ValueError(
                f"{field.channels} channels in its field, {cfg.channels} in its networks"
            )
        scene = Scene(cfg, field, meta["inv_s"])
        tables = field.features.data, scene.radiance.directions.table.data
        for (name, stored_as), table in zip(TABLES.items(), tables, strict=True):
            rows, values = (tensors.pop(k) for k in stored_as)
            table.flatten(0, -2)[rows.long()] = values.float()
            tensors[name] = table
        packed = {n: tensors.pop(k) for n in PACKED if (k := f"field.sdf_{n}") in tensors}
        if packed:
            tensors["field.sdf"] = unpack(packed, grid.size, SHELL * grid.voxel_size)
        scene.load_state_dict(tensors)
        return scene.eval(), meta["state"]
    except (RuntimeError, KeyError, TypeError, ValueError, IndexError) as error:
        raise DataError(f"{path}: does not fit its own description: {error}") from error


def load_scene(run: str | Path) -> Scene:
    """The scene of a run, see `load_checkpoint`."""
    return load_checkpoint(run)[0]
