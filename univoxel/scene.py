"""A scene: field, heads and light; and its checkpoint."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, astuple, dataclass, field, replace
from pathlib import Path
from typing import Literal, TypeAlias

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from univoxel.data import Photos
from univoxel.fields.base import AbstractField
from univoxel.fields.dense import DenseField
from univoxel.fields.hashed import HashField, Levels
from univoxel.fields.heads import MaterialHead, RadianceHead
from univoxel.fields.hull import GridShape
from univoxel.fields.sparse import SparseField, pack_bricks, unpack_bricks
from univoxel.lights import (
    EnvmapLight,
    EnvmapSGLight,
    LightConfig,
    LocalMLP,
    LocalSG,
    LocalSH,
    MLPLightConfig,
    SGConfig,
    SHConfig,
    build,
    read_config,
)
from univoxel.lights.distant import DistantLight
from univoxel.lights.mirrored import MirroredLight
from univoxel.lights.views import ViewLights
from univoxel.networks import DirectionTable
from univoxel.ops import VisibilityScene
from univoxel.packing import PACKED, pack, unpack
from univoxel.poses import PoseSteps
from univoxel.records import Bricks

FORMAT = 1  # of scene.safetensors; rises when older files cannot be read any more
FILE = "scene.safetensors"
# A file holds their rows that are not 0: parameter, and names of the numbers and values of rows
TABLES = {
    "field.features": ("field.feature_rows", "field.feature_values"),
    "radiance.directions.table": ("radiance.direction_rows", "radiance.direction_values"),
}
SHELL = 4.0  # voxels around the surface, beyond which a finished scene needs no features
HALF_MAX = 65504.0

Varying: TypeAlias = Literal["none", "exposure", "light"]


@dataclass(frozen=True)
class SceneConfig:
    """Sizes of the model."""

    channels: int = 16  # features per voxel, >= 1
    material_channels: int = 8  # of them, that albedo and roughness are decoded from, >= 1
    hidden: int = 64  # width of the material and radiance heads, >= 1
    mirror_levels: int = 5  # of the table of mirrored directions, 29 degrees and finer, [0, 8]
    sky_nodes: int = 512  # directions of the environment map, >= 0; 0: the scene has none
    mirrored: bool = True  # whether a local light gets a network for what is mirrored sharply
    light: LightConfig = field(default_factory=SGConfig)
    varying: Varying = "none"  # what differs from photograph to photograph, see ViewLights
    codes: int = 8  # numbers that tell the light of a view, where that varies, >= 1
    # Training fills in whether the photographs' cameras are learned too, see PoseSteps, and their
    # names where something differs from one to another
    refined: bool = False
    views: tuple[str, ...] = ()

    def __post_init__(self):
        for name in ("channels", "material_channels", "hidden", "codes"):
            if getattr(self, name) < 1:
                raise ValueError(
                    f"SceneConfig: {name} must be at least 1, got {getattr(self, name)}"
                )
        if not 0 <= self.mirror_levels <= 8:
            raise ValueError(
                f"SceneConfig: mirror_levels must be in [0, 8], got {self.mirror_levels}"
            )
        if self.material_channels > self.channels:
            raise ValueError(
                f"SceneConfig: material_channels must be at most channels ({self.channels}), "
                f"got {self.material_channels}"
            )
        if self.varying not in ("none", "exposure", "light"):
            raise ValueError(
                f"SceneConfig: varying must be none, exposure or light, got {self.varying!r}"
            )
        if self.varying == "light" and not isinstance(
            self.light, SGConfig | SHConfig | MLPLightConfig
        ):
            raise ValueError(
                "SceneConfig: varying light needs hybrid or a local light, sg, sh or mlp, got "
                f"{self.light.kind}; varying exposure goes with every light"
            )


class Scene(nn.Module):
    """Everything that is learned of an object and of the light it stood in."""

    def __init__(self, cfg: SceneConfig, field: AbstractField, inv_s: float = 1.0):
        super().__init__()
        self.cfg = cfg
        self.inv_s = inv_s  # sharpness of the NeuS density, 1 / world units
        self.field = field
        self.material = MaterialHead(cfg.material_channels, cfg.hidden)
        codes = cfg.codes if cfg.varying == "light" else 0
        inputs = cfg.channels + codes  # of what draws photographs: features and the view's code
        self.radiance = RadianceHead(inputs, cfg.hidden, cfg.mirror_levels)
        self.light = build(inputs, cfg.light)
        self.sky = DistantLight(cfg.sky_nodes) if cfg.sky_nodes else None
        self.mirrored = None
        if cfg.mirrored and isinstance(cfg.light, SGConfig | SHConfig | MLPLightConfig):
            known = self.radiance.directions.channels
            self.mirrored = MirroredLight(inputs, cfg.hidden, cfg.light.scale, known)
        self.views = None
        if cfg.varying != "none":
            directions = self.sky.direction if codes and self.sky else None
            self.views = ViewLights(cfg.views, codes, directions)
        self.poses = PoseSteps(len(cfg.views)) if cfg.refined else None
        if codes:  # at first they change nothing
            assert isinstance(self.light, LocalSG | LocalSH | LocalMLP)
            nets = [self.radiance.net, self.light.head]
            nets += [self.mirrored.net] if self.mirrored else []
            for net in nets:
                net.linear[0].weight.data[:, cfg.channels : inputs] = 0
        self._occluder: VisibilityScene | None = None

    def coded(self, features: Tensor, view: Tensor | int | None = None) -> Tensor:
        """Features [N, C] as the networks of light read them: [N, C + Z], with the view's code.

        Args:
            view: [N] int64 number of a photograph, or one for all; None: the light that is shown.
        """
        code = None if self.views is None else self.views.code(view)
        if code is None:
            return features
        return torch.cat([features, code.expand(len(features), -1)], 1)

    def exposed(self, radiance: Tensor, view: Tensor | int | None = None) -> Tensor:
        """Linear radiance [N, 3] with the gain of photographs; view as in `coded`."""
        return radiance if self.views is None else radiance * self.views.gain(view)

    def registered(self, photos: Photos) -> Photos:
        """The photographs that it was trained on, their cameras where they are believed to be.

        Raises:
            ValueError: other photographs, where cameras are refined.
        """
        if self.poses is None:
            return photos
        return replace(photos, cameras=self.poses.corrected(photos.cameras))

    def show_light_of(self, view: str | None) -> None:
        """Choose the photograph, by name or number, whose light is shown; None: the mean of all.

        Raises:
            ValueError: no such photograph, or the scene has one light for all.
        """
        if self.views is not None:
            self.views.choose(view)
        elif view is not None:
            raise ValueError(
                f"--light-of: all views of this run have one light, got {view!r}; it was trained "
                "without --varying"
            )

    def occluder(self) -> VisibilityScene:
        """The surface, ready for rays: as it was when first asked for since `surface_moved`.

        Raises:
            ValueError: the scene has no surface.
        """
        if self._occluder is None:
            self._occluder = VisibilityScene(*self.field.isosurface())
        return self._occluder

    def surface_moved(self) -> None:
        """Say that the field has changed: `occluder` looks at it anew."""
        self._occluder = None

    def environment(self) -> DistantLight | EnvmapLight | EnvmapSGLight | None:
        """The one distant map that the scene stood in, where it has one; without gains."""
        if isinstance(self.light, EnvmapLight | EnvmapSGLight):
            return self.light
        change = self.views.sky_change() if self.views else None
        if self.sky is None or self.views is None or self.views.chosen is None or change is None:
            return self.sky
        return self.sky.changed(change[self.views.chosen])


def stored(scene: Scene, slim: bool = False, reach: float | None = None) -> dict[str, Tensor]:
    """The tensors of a scene's file, see `save_scene`."""
    tensors = {k: v.contiguous() for k, v in scene.state_dict().items() if k not in TABLES}
    sdf = scene.field.sdf.detach()
    if isinstance(bricks := scene.field.distances, SparseField):
        tensors |= {f"field.{k}": v for k, v in pack_bricks(bricks).items()}
        sdf = tensors["field.sdf"] = sdf[: Bricks.NODES * bricks.count]
    # Features that no sample has touched are 0: only the others are stored.
    features = scene.field.features.detach().flatten(0, -2)
    if scene.field.by_node:
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
        OSError: names the file when it cannot be written; the one before stays.
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
    if isinstance(scene.field, HashField):
        meta["levels"] = astuple(scene.field.levels)
    path = run / FILE
    temporary = path.with_suffix(".partial")
    try:
        save_file(tensors, temporary, {"univoxel": json.dumps(meta)})
        os.replace(temporary, path)
    except (OSError, SafetensorError) as error:
        temporary.unlink(missing_ok=True)
        raise OSError(f"{path}: cannot write the checkpoint: {error}") from error
    return path


def load_checkpoint(run: Path) -> tuple[Scene, dict]:
    """The scene of a run, in evaluation mode, and the state it was saved with.

    Raises:
        FileNotFoundError: no checkpoint there.
        ValueError: one that is cut short, damaged, or of another version.
    """
    path = Path(run) / FILE
    if not path.is_file():
        raise FileNotFoundError(
            f"no checkpoint in {run} (looked for {FILE}); run `univoxel train` first"
        )
    try:
        with safe_open(path, "pt") as file:
            meta = json.loads((file.metadata() or {}).get("univoxel", "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}
    except (SafetensorError, OSError, ValueError) as error:
        raise ValueError(f"{path}: damaged or cut short: {error}") from error
    if meta.get("format") != FORMAT:
        raise ValueError(
            f"{path}: expected checkpoint format {FORMAT}, got {meta.get('format')}; "
            "it was written by another version of univoxel"
        )
    try:
        light = read_config(meta["scene"].pop("light"))
        views = tuple(meta["scene"].pop("views", ()))
        if "mirror_levels" not in meta["scene"]:  # a file from before there were any
            meta["scene"]["mirror_levels"] = 0
            none = torch.zeros(0, dtype=torch.int32), torch.zeros(0, DirectionTable.per_level)
            tensors |= zip(TABLES["radiance.directions.table"], none, strict=True)
        cfg = SceneConfig(**meta["scene"], light=light, views=views)
        grid = GridShape(
            tuple(meta["grid"]["origin"]), meta["grid"]["voxel_size"], tuple(meta["grid"]["size"])
        )
        kind = meta.get("field", "dense")
        channels = 0 if kind == "hash" else cfg.channels
        if "field.place" in tensors:
            where = tensors.pop("field.place"), tensors.pop("field.inside")
            field = SparseField(grid, channels, unpack_bricks(*where, grid.size))
        else:
            field = DenseField(grid, channels)
        if kind == "hash":
            lower, upper, sizes, *rows = meta["levels"]
            levels = Levels(tuple(lower), tuple(upper), tuple(sizes), *rows)
            field = HashField(field, levels)
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
        raise ValueError(f"{path}: does not fit its own description: {error}") from error


def load_scene(run: Path) -> Scene:
    """The scene of a run, see `load_checkpoint`."""
    return load_checkpoint(run)[0]
