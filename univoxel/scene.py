"""A scene: field, networks and light; writing it to a file and reading it back."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, astuple, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from univoxel import lights
from univoxel.camera import PoseSteps
from univoxel.core.choices import FieldName, Varying
from univoxel.core.files import replacing
from univoxel.core.records import HALF_MAX, Bricks
from univoxel.core.validation import check_fields, check_settings, record, setting
from univoxel.data import Photos
from univoxel.errors import ConfigError, DataError, FileError, MissingFile, UserError
from univoxel.fields.bricks import BrickDistances, pack_bricks, unpack_bricks
from univoxel.fields.distances import PACKED, DenseDistances, SurfaceVersion, pack, unpack
from univoxel.fields.field import Field, HashField, Levels, MaterialHead, NodeField, RadianceHead
from univoxel.fields.grid import GridShape
from univoxel.lights.base import MOST_ROWS, MirroredLight
from univoxel.lights.latlong import DistantLight
from univoxel.lights.views import Flash, Turntable, ViewLights
from univoxel.ops import VisibilityScene
from univoxel.ops.networks import DirectionTable


@dataclass(frozen=True)
class SceneConfig:
    """Sizes of the model."""

    channels: int = setting(16, "number of features per voxel", least=1)
    material_channels: int = setting(
        8, "number of features from which the material head decodes the material", least=1
    )
    hidden: int = setting(64, "width of the material and radiance heads", least=1)
    mirror_levels: int = setting(5, "levels of the table of reflected directions", least=0, most=8)
    sky_nodes: int = setting(512, "number of nodes of the environment map; 0: no map", least=0)
    sky_rows: int = setting(
        0,
        "number of rows of the environment map; only runs of version 0.2 use this",
        least=0,
        most=MOST_ROWS,
    )
    mirrored: bool = setting(
        True, "whether local light has a specular network, for sharp reflections"
    )
    light: lights.LightConfig = setting(lights.SGConfig(), "lighting model and its sizes")
    roughness: float | None = setting(
        None,
        "known roughness of an object without metal; None: roughness and metallic are learned",
        above=0,
        most=1,
    )
    turntable: Turntable | None = setting(
        None, "axes about which the light rotates with the camera; None: the light is fixed"
    )
    flash: float | None = setting(
        None,
        "distance between the object and a flash on the camera; None: there is no flash",
        unit="world units",
        above=0,
    )
    varying: Varying = setting("none", "what varies between photographs; light includes exposure")
    codes: int = setting(8, "size of the appearance embedding of each view", least=1)
    refined: bool = setting(False, "whether camera poses are optimised; training sets this")
    views: tuple[str, ...] = setting(
        (), "names of the photographs if each has its own parameters; training sets this"
    )

    def __post_init__(self) -> None:
        check_settings(self)
        most = f"at most channels ({self.channels})"
        check_fields(self, most, lambda x: x <= self.channels, "material_channels")
        if self.turntable is not None and not isinstance(self.light, lights.LocalLightConfig):
            raise ConfigError(
                "SceneConfig: light_frame=turntable, in which the light rotates with the camera, "
                f"needs light=hybrid, sg, sh or mlp, got {self.light.kind}",
                "light_frame",
                "light",
            )
        if self.turntable is not None and self.varying == "light":
            raise ConfigError(
                "SceneConfig: light that rotates with the camera (light_frame=turntable) cannot "
                "also differ between photographs (varying=light): use varying=exposure or none",
                "light_frame",
                "varying",
            )
        if self.varying == "light" and not isinstance(self.light, lights.LocalLightConfig):
            raise ConfigError(
                "SceneConfig: varying=light needs light=hybrid, sg, sh or mlp, got "
                f"{self.light.kind}; varying=exposure works with all lighting models",
                *("varying", "light"),
            )


class Scene(nn.Module):
    """All that is learned about an object and its light."""

    def __init__(self, cfg: SceneConfig, field: Field, inv_s: float = 1.0) -> None:
        super().__init__()
        self.cfg: SceneConfig = cfg
        self.inv_s = inv_s  # sharpness of the NeuS density, 1 / world units
        self.field = field
        self.material: MaterialHead = MaterialHead(cfg.material_channels, cfg.hidden, cfg.roughness)
        codes = cfg.codes if cfg.varying == "light" else 0
        inputs = cfg.channels + codes  # of what draws photographs: features and the view's code
        self.radiance: RadianceHead = RadianceHead(inputs, cfg.hidden, cfg.mirror_levels)
        self.light: lights.AbstractLight = lights.build(inputs, cfg.light)
        self.sky: DistantLight | None = None
        if cfg.sky_nodes:
            self.sky = DistantLight(cfg.sky_nodes, rows=cfg.sky_rows)
        self.mirrored = None
        if cfg.mirrored and isinstance(cfg.light, lights.LocalLightConfig):
            known = self.radiance.directions.channels
            self.mirrored: MirroredLight | None = MirroredLight(
                inputs, cfg.hidden, cfg.light.scale, known
            )
        self.views = None
        if cfg.varying != "none":
            directions = self.sky.direction if codes and self.sky else None
            self.views: ViewLights | None = ViewLights(cfg.views, codes, directions)
        self.flash: Flash | None = None if cfg.flash is None else Flash(cfg.flash)
        self.poses: PoseSteps | None = PoseSteps(len(cfg.views)) if cfg.refined else None
        if codes:  # at first they change nothing
            assert isinstance(self.light, lights.AbstractLocalLight)
            nets = [self.radiance.net, self.light.head]
            nets += [self.mirrored.net] if self.mirrored else []
            for net in nets:
                net.linear[0].weight.data[:, cfg.channels : inputs] = 0
        self._traced: tuple[VisibilityScene, SurfaceVersion] | None = None  # see `occluder`
        self._held = False

    def coded(self, features: Tensor, view: Tensor | int | None = None) -> Tensor:
        """Append the view's appearance embedding to features [N, C]: [N, C + Z].

        Args:
            view: [N] int64 index of a photograph, or one for all; None: the chosen light.
        """
        code = None if self.views is None else self.views.code(view)
        if code is None:
            return features
        return torch.cat([features, code.expand(len(features), -1)], 1)

    def exposed(self, radiance: Tensor, view: Tensor | int | None = None) -> Tensor:
        """Linear radiance [N, 3] with the gain of photographs; view as in `coded`."""
        return radiance if self.views is None else radiance * self.views.gain(view)

    def registered(self, photos: Photos) -> Photos:
        """The photographs that it was trained on, their cameras where they are believed to be; a
        UserError for others, where cameras are refined."""
        if self.poses is None:
            return photos
        return replace(photos, cameras=self.poses.corrected(photos.cameras))

    def show_light_of(self, view: str | None) -> None:
        """Choose the photograph, by name or number, whose light is used; None: the mean of all. A
        UserError if there is no such photograph, or one light for all."""
        if self.views is not None:
            self.views.choose(view)
        elif view is not None:
            raise UserError(
                f"light_of={view}: all views of this run share one light; to learn a light for "
                "each view, train with varying=light",
                "light_of",
                "varying",
            )

    def occluder(self) -> VisibilityScene:
        """The present surface, ready for rays; within `surface_held`, the one that is held.
        NoSurface if there is none."""
        if self._traced is not None:
            tracer, version = self._traced
            if self._held or version.holds(self.field.sdf):
                return tracer
        tracer = VisibilityScene(*self.field.isosurface())
        self._traced = tracer, SurfaceVersion.of(self.field.sdf)
        return tracer

    @contextmanager
    def surface_held(self) -> Iterator[None]:
        """A block in which `occluder` stays as it was first asked for, though the surface moves,
        until `release_surface`: tracing again in every step would cost more than the step."""
        stale = self._traced is not None and not self._traced[1].holds(self.field.sdf)
        if stale and not self._held:
            self._traced = None
        before, self._held = self._held, True
        try:
            yield
        finally:
            self._held = before

    def release_surface(self) -> None:
        """Within `surface_held`: hold the present surface from now on."""
        self._traced = None

    def __getstate__(self) -> dict[str, Any]:
        """For copies: what traces rays cannot be copied, and is made again."""
        return self.__dict__ | {"_traced": None, "_held": False}

    def environment(self) -> DistantLight | lights.EnvmapLight | lights.EnvmapSGLight | None:
        """The environment map that is the same for all photographs, if there is one; no gains."""
        if isinstance(self.light, lights.EnvmapLight | lights.EnvmapSGLight):
            return self.light
        change = self.views.sky_change() if self.views else None
        if self.sky is None or self.views is None or self.views.chosen is None or change is None:
            return self.sky
        return self.sky.changed(change[self.views.chosen])


# The file of a scene: what it holds, and reading it back.


FORMAT = 1  # of scene.safetensors; rises when older files cannot be read any more
FILE = "scene.safetensors"
# A file holds their rows that are not 0: parameter, and names of the numbers and values of rows
TABLES = {
    "field.features": ("field.feature_rows", "field.feature_values"),
    "radiance.directions.table": ("radiance.direction_rows", "radiance.direction_values"),
}
SDF = tuple(f"field.sdf_{name}" for name in PACKED)  # the same for distances
LEVELS = "lower", "upper", "voxel_sizes", "rows"
# Rows of a table for each that a file holds, at most, beyond a small table: a surface of 4 voxels'
# width in a grid has more, and what claims to have fewer wants memory for nothing
ROWS_FOR_ONE = 4096
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
    if isinstance(scene.field, NodeField):
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
        halves = {"field.sdf", "field.sdf_values", "sky.sharp"}
        halves |= {values for _, values in TABLES.values()}
        for name in halves & tensors.keys():
            tensors[name] = tensors[name].clamp(-HALF_MAX, HALF_MAX).half()
    return tensors


def save_scene(
    scene: Scene, run: Path, state: dict[str, Any], slim: bool = False, reach: float | None = None
) -> Path:
    """Write run/scene.safetensors atomically; `state` (JSON) is stored in its metadata.

    Args:
        slim: for a finished scene: store the grids in half precision, and features only where rays
            meet the surface. Otherwise, loading gives back the same bits.
        reach: narrow-band width in voxels, > 0: beyond it a slim file stores only the sign of a
            node's distance; None: SHELL for features and no limit for distances.

    Raises:
        FileError: the file cannot be written; the earlier one is unchanged.
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
    try:
        with replacing(path) as temporary:
            save_file(tensors, temporary, {"univoxel": json.dumps(meta)})
    except (OSError, SafetensorError) as error:
        raise FileError(f"{path}: cannot write the checkpoint: {error}") from error
    return path


@dataclass(frozen=True)
class Choice:
    """A size that was chosen, as training's state has it."""

    what: str
    before: float
    after: float
    cost: float
    why: str
    said: str = ""


@dataclass(frozen=True)
class Within:
    """A round of the joint stage: Newton steps at its begin, and then Adam."""

    begin: float  # progress of the stage, [0, 1]
    end: float  # the same
    rounds_after: int
    solved: bool  # whether Newton has made a step
    only_metal: bool = False  # as in MaterialLabels
    level: float = 0.0  # of the Newton steps, as in `univoxel.training.newton.NewtonRound`

    def __post_init__(self) -> None:
        check_fields(self, "in [0, 1]", lambda x: 0 <= x <= 1, "begin", "end")
        check_fields(self, "at least 0", lambda x: x >= 0, "rounds_after")


@dataclass(frozen=True)
class State:
    """What of a run's state is known here; a file may have less and more."""

    stage: int = 0
    progress: float = 0.0  # of the stage, in [0, 1]
    step: int = 0
    made: tuple[float, ...] = ()
    early: tuple[int, ...] = ()
    stage_steps: int = 0
    took: tuple[float, ...] = ()
    stage_took: float = 0.0
    finished: bool = False
    within: Within | None = None  # None: at the start of a stage, or in one without rounds
    seconds: float = 0.0
    chosen: tuple[Choice, ...] = ()
    troubles: tuple[str, ...] = ()
    threads: int = 1
    peak_rss_mb: float = 0.0

    def __post_init__(self) -> None:
        counts = "stage", "step", "stage_steps", "seconds"
        check_fields(self, "finite, at least 0", lambda x: 0 <= x < math.inf, *counts)
        check_fields(self, "in [0, 1]", lambda x: 0 <= x <= 1, "progress")


@dataclass(frozen=True)
class Description:
    """What a file says of its tensors."""

    scene: SceneConfig
    grid: GridShape
    inv_s: float
    field: FieldName = "dense"
    levels: Levels | None = None  # of a hash field

    def __post_init__(self) -> None:
        check_fields(self, "above 0", lambda x: 0 < x < math.inf, "inv_s")
        if (self.field == "hash") != (self.levels is not None):
            asked = "must be left out" if self.levels else "are required"
            raise ConfigError(f"Description: levels {asked} for a {self.field} field")


def load_checkpoint(run: str | Path) -> tuple[Scene, dict[str, Any]]:
    """The scene of a run, in evaluation mode, and the state that was saved with it.

    Sizes in the file are compared with its tensors before memory is allocated for them.

    Raises:
        MissingFile: the run has no checkpoint.
        DataError: the checkpoint is truncated, damaged or of another version.
    """
    path = Path(run) / FILE
    if not path.is_file():
        raise MissingFile(f"{run}: not a trained run (no {FILE}): run `univoxel train` first")
    meta, tensors = _read(path)
    state = meta.get("state", {})
    try:
        record(State, {k: v for k, v in state.items() if k in State.__dataclass_fields__})
        about = _description(meta, tensors)
        bricks = None
        if "field.place" in tensors:
            where = tensors.pop("field.place"), tensors.pop("field.inside")
            bricks = unpack_bricks(*where, about.grid.size)
        with torch.device("meta"):  # sizes only
            _compare(_scene(about, bricks), tensors)
        scene = _scene(about, bricks)
        _unpack_(scene, tensors)
        scene.load_state_dict(tensors)
        return scene.eval(), state
    except (RuntimeError, KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise DataError(f"{path}: the tensors do not match the header: {error}") from error


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """What a file says of itself, and its tensors, all finite."""
    try:
        with safe_open(path, "pt") as file:
            meta = json.loads((file.metadata() or {}).get("univoxel", "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}
    except (SafetensorError, OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: damaged or truncated: {error}") from error
    if not isinstance(meta, dict) or meta.get("format") != FORMAT:
        came = meta.get("format") if isinstance(meta, dict) else meta
        raise DataError(
            f"{path}: expected checkpoint format {FORMAT}, got {came!r:.60}: open it with the "
            "version of univoxel that wrote it, or train again"
        )
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not tensor.isfinite().all():
            raise DataError(f"{path}: damaged: {name} contains NaN or infinity")
    return meta, tensors


def _description(meta: dict[str, Any], tensors: dict[str, Tensor]) -> Description:
    """The description, also of files from before there were all of its parts, which get them."""
    scene = dict(meta["scene"])
    scene["light"] = lights.read_config(scene["light"])
    if "mirror_levels" not in scene:
        scene["mirror_levels"] = 0
        none = torch.zeros(0, dtype=torch.int32), torch.zeros(0, DirectionTable.per_level)
        tensors |= zip(TABLES["radiance.directions.table"], none, strict=True)
    known = {k: meta[k] for k in ("grid", "inv_s", "field") if k in meta}
    if levels := meta.get("levels"):
        known["levels"] = dict(zip(LEVELS[: len(levels)], levels, strict=True))
    return record(Description, known | {"scene": scene})


def _scene(about: Description, bricks: Bricks | None) -> Scene:
    """A scene as described, its values yet unknown."""
    distances = DenseDistances(about.grid) if bricks is None else BrickDistances(about.grid, bricks)
    if about.levels:
        field = HashField(distances, about.levels)
    else:
        field = NodeField(distances, torch.zeros(*distances.sdf.shape, about.scene.channels))
    if field.channels != about.scene.channels:
        raise ValueError(
            f"the field has {field.channels} channels, but the networks use {about.scene.channels}"
        )
    return Scene(about.scene, field, about.inv_s)


def _compare(scene: Scene, tensors: dict[str, Tensor]) -> None:
    """Refuse tensors of a file that are not those of the scene, which need hold no memory."""
    expected = scene.state_dict()
    parts: dict[str, tuple[str, ...]] = dict(TABLES)
    if not tensors.keys().isdisjoint(SDF):
        parts["field.sdf"] = SDF
    names = {n for name in expected for n in parts.get(name, (name,))}
    if different := names ^ tensors.keys():
        what = "is missing" if min(different) in names else "is unknown"
        raise ValueError(f"{min(different)} {what}")
    for name, value in expected.items():
        if name in parts:
            rows, values, *_ = (tensors[n] for n in parts[name])
            _compare_rows(name, value, rows, values)
        elif tensors[name].shape != value.shape:
            came = list(tensors[name].shape)
            raise ValueError(f"expected {name} with shape {list(value.shape)}, got {came}")
        elif tensors[name].is_floating_point() != value.is_floating_point():
            raise ValueError(f"expected {name} of type {value.dtype}, got {tensors[name].dtype}")


def _compare_rows(name: str, table: Tensor, rows: Tensor, values: Tensor) -> None:
    """Refuse rows that are no table's."""
    channels = [] if name == "field.sdf" else [table.shape[-1]]
    count = table.numel() // math.prod(channels)
    if rows.dtype != torch.int32 or list(values.shape) != [*rows.shape, *channels]:
        raise ValueError(
            f"expected int32 row numbers of {name} and {channels} values for each, got row numbers "
            f"{list(rows.shape)} {rows.dtype} and values {list(values.shape)}"
        )
    if count > ROWS_FOR_ONE * (len(rows) + ROWS_FOR_ONE):
        raise ValueError(f"{name} has {count} rows, but the file stores only {len(rows)}")
    if len(rows) and not 0 <= int(rows.min()) <= int(rows.max()) < count:
        raise ValueError(f"row numbers of {name} must be in [0, {count}), but some are not")


def _unpack_(scene: Scene, tensors: dict[str, Tensor]) -> None:
    """Replace what files hold of tables, and of distances, by the whole of them."""
    tables = scene.field.features.data, scene.radiance.directions.table.data
    for (name, stored_as), table in zip(TABLES.items(), tables, strict=True):
        rows, values = (tensors.pop(k) for k in stored_as)
        table.flatten(0, -2)[rows.long()] = values.float()
        tensors[name] = table
    packed = {n: tensors.pop(k) for n, k in zip(PACKED, SDF, strict=True) if k in tensors}
    if packed:
        grid = scene.field.grid
        tensors["field.sdf"] = unpack(packed, grid.size, SHELL * grid.voxel_size)


def load_scene(run: str | Path) -> Scene:
    """The scene of a run, see `load_checkpoint`."""
    return load_checkpoint(run)[0]
