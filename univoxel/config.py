"""The whole configuration of a training run, and its file."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, get_args

from univoxel import __version__
from univoxel.core.choices import (
    FIELDS,
    CamerasFrom,
    Capacity,
    Detailing,
    FieldName,
    LightFrameOrAuto,
    MasksFrom,
)
from univoxel.core.files import read_json, replacing
from univoxel.core.validation import check_fields, record, without_retired
from univoxel.errors import ConfigError, MissingFile, UserError
from univoxel.fields.features import PER_LEVEL
from univoxel.lights import read_config
from univoxel.scene import SceneConfig

# Arguments that a configuration is made of
CHOICES = (
    *(
        "preset",
        "minutes",
        "light",
        "varying",
        "light_frame",
        "metal",
        "masks",
        "cameras",
        "downscale",
        "capacity",
        "detail",
    ),
    *("budget_mb", "changes"),
)


# Most of a limit of time that reading and preparation may take; stages share the rest
PREPARATION = 0.25
_WHOLE = ("at least 1", lambda x: x >= 1)
_ABOVE = ("above 0", lambda x: 0 < x < math.inf)
_NOT_BELOW = ("at least 0", lambda x: 0 <= x < math.inf)
_SHARE = ("in (0, 1]", lambda x: 0 < x <= 1)


@dataclass(frozen=True)
class StageConfig:
    """One stage of training, on a grid of its own resolution."""

    voxels: float  # millions in the object's box at most, > 0; see TrainConfig.voxel_pixels
    iterations: int  # optimisation steps, >= 1; fewer when time runs out
    share: float  # of the time that is left for stages under a limit, (0, 1]
    rays: int = 2048  # per step, >= 1
    sharpness: tuple[float, float] = (0.5, 0.5)  # s of the NeuS density at begin and end, voxels
    lr_sdf: tuple[float, float] = (0.2, 0.02)  # at begin and end, voxels per step; all rates > 0
    # at begin and end: of features, and of the table of mirrored directions
    lr_features: tuple[float, float] = (0.1, 0.01)
    # at begin and end: of the networks, the light, and what differs from view to view
    lr_networks: tuple[float, float] = (3e-3, 3e-4)
    plate: float = 0.003  # thin-plate smoothing of touched sdf nodes per step, [0, 0.125]
    spread: int = 4  # passes that smooth the sdf's gradient before the optimiser, >= 0
    diffusion: float = 0.01  # smoothing of touched feature nodes per step, [0, 0.25]
    physical_from: float = 1.0  # progress in [0, 1] at which the physically based render joins
    # progress in [0, 1] at which patches of the surface are compared between photographs; 1: never
    patches_from: float = 1.0
    refit: bool = False  # materials stay; light, radiance and silhouettes follow them
    # sparse: only bricks around the surface are stored; hash: features come from a hash table
    field: FieldName = "dense"

    def __post_init__(self) -> None:
        check_fields(self, "above 0", lambda x: 0 < x < math.inf, "voxels")
        check_fields(self, "at least 1", lambda x: x >= 1, "iterations", "rays")
        check_fields(self, "in (0, 1]", lambda x: 0 < x <= 1, "share")
        check_fields(
            self,
            "two numbers above 0",
            lambda x: len(x) == 2 and all(0 < v < math.inf for v in x),
            *("sharpness", "lr_sdf", "lr_features", "lr_networks"),
        )
        check_fields(self, "at least 0", lambda x: x >= 0, "spread")
        check_fields(self, "in [0, 0.125]", lambda x: 0 <= x <= 0.125, "plate")
        check_fields(self, "in [0, 0.25]", lambda x: 0 <= x <= 0.25, "diffusion")
        check_fields(self, "in [0, 1]", lambda x: 0 <= x <= 1, "physical_from", "patches_from")
        check_fields(self, "dense, sparse or hash", lambda x: x in FIELDS, "field")


@dataclass(frozen=True)
class LossConfig:
    """Weights >= 0 of the losses; the photometric loss of the physically based render has 1."""

    radiance: float = 1.0  # photometric loss of what the radiance head shows
    silhouette: float = 0.1  # rays' opacity against the masks
    metallic: float = 0.01  # what the mean metallic costs: metal is for where nothing else serves
    light_smoothness: float = 0.1  # change of a local light over about a voxel, L1
    # distance of the light from grey on the whole, as a share of it: photographs fix albedo and
    # light up to a colour only
    white_light: float = 0.01
    map_smoothness: float = 1e-3  # total variation of the log map
    # what patches of the surface lack in correlation between photographs, in every second step
    patches: float = 0.4

    def __post_init__(self) -> None:
        names = [f.name for f in fields(self)]
        check_fields(self, "at least 0", lambda x: 0 <= x < math.inf, *names)


@dataclass(frozen=True)
class MetalConfig:
    """Which points are metal, see training/metals.py."""

    # brightest channel of a metal at least, [0, 1]: metals in use reflect 0.4 and more
    min_reflectance: float = 0.25

    def __post_init__(self) -> None:
        check_fields(self, "in [0, 1]", lambda x: 0 <= x <= 1, "min_reflectance")


@dataclass(frozen=True)
class MirrorConfig:
    """The map that mirrors show, see training/mirrors.py."""

    # rows of the map as sharp points show it, a multiple of 32; 0: it is not kept
    rows: int = 128

    def __post_init__(self) -> None:
        rows = range(0, 1025, 32)
        check_fields(self, "a multiple of 32 in [0, 1024]", lambda x: x in rows, "rows")


@dataclass(frozen=True)
class EntropyConfig:
    """The prior that paint comes in few colours, see training/albedo_entropy.py."""

    # steps, >= 1, in which the materials learn the albedos under a map that was changed
    teaching_steps: int = 60

    def __post_init__(self) -> None:
        check_fields(self, *_WHOLE, "teaching_steps")


@dataclass(frozen=True)
class JointConfig:
    """The stage that solves for one map, the materials and normals, see training/joint_solve.py."""

    iterations: int = 700  # Adam steps in all rounds, >= 1; fewer when time runs out
    share: float = 0.4  # of the time budget, (0, 1]
    rays: int = 4096  # observations per step, >= views
    views: int = 4  # observations of a point per step, >= 1
    rounds: int = 4  # of Newton steps on the map and then of Adam, >= 1
    points: int = 20000  # on the surface, >= 1
    tracing: int = 2  # visibility rays per point and direction, >= 1
    colors: bool = True  # whether the light minimises the entropy of albedo, see entropy
    # whether all is metal, as dark as it looks, and the map neutral; None: trials decide
    only_metal: bool | None = None
    lr_features: float = 0.03  # at the begin of a round; all rates > 0
    # at the begin of a round: of the materials' head and the views' gains
    lr_networks: float = 3e-3
    lr_map: float = 0.05  # of the log map
    lr_sdf: float = 0.04  # of the surface, voxels per step, >= 0; 0: it stays
    newton_steps: int = 3  # at the begin of a round, >= 0
    newton_points: int = 4000  # of the points, >= 1
    newton_views: int = 8  # observations of each, >= 2
    newton_roughness: float = 0.1  # standard deviation that roughness follows the map with; 0: none
    newton_smooth: float = 1e-7  # Laplacian on the log map against the mean squared residual, > 0
    # how points are decided to be metal
    metal: MetalConfig = field(default_factory=MetalConfig)
    # the map that mirrors show
    mirror: MirrorConfig = field(default_factory=MirrorConfig)
    # the prior on few colours, where colors is set
    entropy: EntropyConfig = field(default_factory=EntropyConfig)

    def __post_init__(self) -> None:
        counts = ("iterations", "views", "rounds", "points", "tracing", "newton_points")
        check_fields(self, *_WHOLE, *counts)
        check_fields(self, *_SHARE, "share")
        check_fields(self, "at least views", lambda x: x >= self.views, "rays")
        check_fields(self, *_ABOVE, "lr_features", "lr_networks", "lr_map", "newton_smooth")
        check_fields(self, *_NOT_BELOW, "lr_sdf", "newton_steps", "newton_roughness")
        check_fields(self, "at least 2", lambda x: x >= 2, "newton_views")


@dataclass(frozen=True)
class TrainConfig:
    data: Path  # folder of the data set
    out: Path  # folder of the run
    # in the order in which they are trained, >= 1: a StageConfig first, which makes the grid
    stages: tuple[StageConfig | JointConfig, ...]
    # wall-clock limit from the first photograph read to the end, > 0: what does not fit is cut, in
    # all stages alike; None: all steps are made, however long they take
    minutes: float | None = None
    # pixels of the photographs along a side of one that is trained on, >= 1; 0: as many as leave
    # what grids can use, 1 for photographs of 1499 pixels and fewer. A run's config.json has the
    # number that was found
    downscale: int = 0
    # pixels of the photographs, where the object is, that a voxel is at least as wide as, >= 0: a
    # finer grid would only learn their noise
    voxel_pixels: float = 1.0
    # of the random numbers of training: first parameters, rays, points. Which rays are held out
    # does not depend on it
    seed: int = 0
    # auto: masks that end outside of the object, as the photographs show it, are taken in
    masks: MasksFrom = "given"
    # refined: the photographs' cameras are put right, before training and in it; auto: where their
    # silhouettes contradict one another
    cameras: CamerasFrom = "given"
    # whether photographs are looked at for exposures that differ; where they do, scene.varying
    # becomes exposure, of none
    exposures: bool = False
    # whether what the data set's files and links name may lie outside of its folder
    allow_outside: bool = False
    # what the light stands still in: the world of the cameras, or the room of a turntable, whose
    # camera stood still too; auto: which of the two explains better how colours change from
    # photograph to photograph. scene.turntable then holds the axis
    light_frame: LightFrameOrAuto = "world"
    # texture: after training, albedo comes from the photographs at their own size, where they show
    # more than the grid holds
    detail: Detailing = "none"
    # seconds, >= 0, that carving concavities before training may be expected to take on two cores,
    # or they are left alone: those that no silhouette shows, where photographs agree on them. Never
    # where their light varies, other than in exposure; 0: never
    carving_seconds: float = 0.0
    # dB that held-out rays must gain in 15 % of a stage, or it is shortened, >= 0; 0: never
    patience: float = 0.0
    capacity: Capacity = "fixed"  # adaptive: sizes above are limits, see training/compression.py
    budget_mb: float | None = None  # 1e6 bytes that the model's file may have, > 0; adaptive only
    # sizes of the model, and what light it has
    scene: SceneConfig = field(default_factory=SceneConfig)
    loss: LossConfig = field(default_factory=LossConfig)  # weights in each StageConfig

    def __post_init__(self) -> None:
        check_fields(self, "a path", lambda x: isinstance(x, Path), "data", "out")
        check_fields(self, "a path in UTF-8", _is_utf8, "data", "out")
        check_fields(
            self,
            "a StageConfig first, which makes the grid",
            lambda x: len(x) >= 1 and isinstance(x[0], StageConfig),
            "stages",
        )
        kinds = [s.field for s in self.stages if isinstance(s, StageConfig)]
        if "hash" in kinds and set(kinds) != {"hash"}:
            raise ConfigError(
                f"TrainConfig: hash is for all stages or none, got {', '.join(kinds)}"
            )
        if kinds != sorted(kinds):
            raise ConfigError(
                f"TrainConfig: no dense stage can follow a sparse one, got {', '.join(kinds)}"
            )
        if "hash" in kinds and self.scene.channels % PER_LEVEL:
            raise ConfigError(
                f"TrainConfig: the hash field has {PER_LEVEL} channels a level: scene.channels "
                f"must be a multiple of that, got {self.scene.channels}"
            )
        if self.capacity == "adaptive" and "sparse" in kinds:
            raise ConfigError(
                "TrainConfig: adaptive capacity, and so budget_mb, is for dense and hash fields: "
                "leave it out, or the sparse field",
                "budget_mb",
            )
        if not self.scene.sky_nodes and any(isinstance(s, JointConfig) for s in self.stages):
            raise ConfigError(
                "TrainConfig: a JointConfig stage needs scene.sky_nodes above 0, got 0"
            )
        check_fields(self, "above 0 or None", lambda x: x is None or x > 0, "minutes")
        names = ("patience", "downscale", "voxel_pixels", "carving_seconds")
        check_fields(self, "at least 0", lambda x: 0 <= x < math.inf, *names)
        check_fields(self, "fixed or adaptive", lambda x: x in get_args(Capacity), "capacity")
        check_fields(self, "none or texture", lambda x: x in get_args(Detailing), "detail")
        frames = get_args(LightFrameOrAuto)
        check_fields(self, "auto, world or turntable", lambda x: x in frames, "light_frame")
        check_fields(self, "auto or given", lambda x: x in get_args(MasksFrom), "masks")
        check_fields(
            self, "auto, given or refined", lambda x: x in get_args(CamerasFrom), "cameras"
        )
        check_fields(self, "above 0 or None", lambda x: x is None or 0 < x < math.inf, "budget_mb")
        if self.budget_mb is not None and self.capacity == "fixed":
            raise ConfigError(
                f"TrainConfig: budget_mb {self.budget_mb:g} needs adaptive capacity, got fixed"
            )


def _is_utf8(path: Path) -> bool:
    """Whether files can hold the name: others can be made, but not every library opens them."""
    try:
        return bool(str(path).encode())
    except UnicodeEncodeError:
        return False


def save_config(cfg: TrainConfig) -> None:
    """Write the resolved configuration to config.json in the run's folder, whole or not at all.

    The version of the package stands before it: constants that are no fields are those of it.

    Raises:
        OSError: it cannot be written.
    """
    values = {"version": __version__} | dataclasses.asdict(cfg)
    text = json.dumps(values, indent=2, default=str)
    with replacing(cfg.out / "config.json") as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def load_config(path: Path) -> TrainConfig:
    """The configuration in a file, as `save_config` wrote it: config.json of a run.

    Raises:
        MissingFile: there is no such file.
        ConfigError: it holds something else; the message names file and field.
    """
    if not path.is_file():
        raise MissingFile(f"{path}: expected a configuration, such as config.json of a run")
    values = read_json(path)
    try:
        if not isinstance(values, dict):
            raise ConfigError(f"expected an object with the configuration, got {values!r:.60}")
        values = {name: value for name, value in values.items() if name != "version"}
        if isinstance(values.get("scene"), dict):
            values["scene"] = dict(values["scene"])
            values["scene"]["light"] = read_config(values["scene"].get("light", {}))
        return record(TrainConfig, values)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def check_same(cfg: TrainConfig) -> None:
    """Refuse to go on with the run in cfg.out under stages or a model that it did not begin with.

    Raises:
        UserError: they differ, or config.json cannot be read.
    """
    path = cfg.out / "config.json"
    try:
        before = read_json(path)
    except (OSError, UserError) as error:
        raise UserError(f"{path}: cannot be read, so the run cannot go on: {error}") from None
    if not isinstance(before, dict):
        raise UserError(f"{path}: expected an object with the configuration, got {before!r:.80}")
    began = _completed(before, cfg)
    # of configurations from before there were any
    since = {"downscale": 1, "voxel_pixels": 0.0, "capacity": "fixed", "budget_mb": None}
    since |= {"masks": "given", "cameras": "given", "exposures": False, "light_frame": "world"}
    began |= {name: value for name, value in since.items() if name not in before}
    now = _as_json(cfg)
    for one in (began, now):
        one["downscale"] = one["downscale"] or 1  # 0 was 1 before it was found
    for name in ("stages", "scene", *since):
        if began.get(name) != now[name]:
            raise UserError(
                f"{path}: the run began with other {name}: resume with the same "
                f"{', '.join(CHOICES[:-1])} and {CHOICES[-1]} as then",
                *CHOICES,
            )


def _completed(before: Any, now: Any) -> Any:
    """A configuration from JSON with the defaults of fields that were added since, and without
    those that are retired.

    Args:
        now: a configuration of the same classes.
    """
    if isinstance(now, tuple) and isinstance(before, list) and len(before) == len(now):
        return [_completed(b, n) for b, n in zip(before, now, strict=True)]
    if not dataclasses.is_dataclass(now) or not isinstance(before, dict):
        return before
    result = without_retired(type(now), before)
    for known in dataclasses.fields(now):
        if known.name in before:
            result[known.name] = _completed(before[known.name], getattr(now, known.name))
        elif known.default is not dataclasses.MISSING:
            result[known.name] = _as_json(known.default)
        elif known.default_factory is not dataclasses.MISSING:
            result[known.name] = _as_json(known.default_factory())
    return result


def _as_json(value: Any) -> Any:
    """A configuration, or a value of one, as config.json holds it."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = dataclasses.asdict(value)
    return json.loads(json.dumps(value, default=str))
