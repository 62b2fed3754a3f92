"""The whole configuration of a training run, and its file."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from univoxel import __version__
from univoxel.core.choices import (
    CamerasFrom,
    Capacity,
    Detailing,
    FieldName,
    LightFrameOrAuto,
    MasksFrom,
)
from univoxel.core.files import read_json, write_json
from univoxel.core.validation import (
    EARLIER,
    about,
    check_fields,
    check_settings,
    record,
    setting,
    without_retired,
)
from univoxel.errors import ConfigError, MissingFile, UserError
from univoxel.fields.features import PER_LEVEL
from univoxel.lights import read_config
from univoxel.scene import SceneConfig

# Arguments that a configuration is made of
CHOICES = (
    *("preset", "minutes", "light", "varying", "light_frame", "metal", "masks", "cameras"),
    *("downscale", "capacity", "detail", "budget_mb", "changes"),
)


# Most of a limit of time that reading and preparation may take; stages share the rest
PREPARATION = 0.25


@dataclass(frozen=True)
class StageConfig:
    """One stage of training, on a grid of its own resolution."""

    voxels: float = field(
        metadata=about("in the object's box at most; see voxel_pixels", unit="millions", above=0)
    )
    iterations: int = field(metadata=about("optimisation steps; fewer when time runs out", least=1))
    share: float = field(
        metadata=about("of the time that is left for stages under a limit", above=0, most=1)
    )
    rays: int = setting(2048, "per step", least=1)
    sharpness: tuple[float, float] = setting(
        (0.5, 0.3), "s of the NeuS density at begin and end", unit="voxels", above=0
    )
    lr_sdf: tuple[float, float] = setting(
        (0.07, 0.005), "learning rate at begin and end", unit="voxels per step", above=0
    )
    lr_features: tuple[float, float] = setting(
        (0.1, 0.01),
        "learning rate at begin and end: of features, and of the table of mirrored directions",
        above=0,
    )
    lr_networks: tuple[float, float] = setting(
        (6e-3, 3e-4),
        "learning rate at begin and end: of the networks, the light, and what differs from view to "
        "view",
        above=0,
    )
    plate: float = setting(
        0.003, "thin-plate smoothing of touched sdf nodes per step", least=0, most=0.125
    )
    spread: int = setting(4, "passes that smooth the sdf's gradient before the optimiser", least=0)
    diffusion: float = setting(
        0.01, "smoothing of touched feature nodes per step", least=0, most=0.25
    )
    physical_from: float = setting(
        0.3, "progress at which the physically based render joins", least=0, most=1
    )
    patches_from: float = setting(
        0.0,
        "progress at which patches of the surface are compared between photographs; 1: never",
        least=0,
        most=1,
    )
    refit: bool = setting(False, "materials stay; light, radiance and silhouettes follow them")
    field: FieldName = setting(
        "hash",
        "sparse: only bricks around the surface are stored; hash: features come from a hash table",
    )

    __post_init__ = check_settings


@dataclass(frozen=True)
class LossConfig:
    """Weights of the losses; the photometric loss of the physically based render has 1."""

    radiance: float = setting(1.0, "photometric loss of what the radiance head shows", least=0)
    silhouette: float = setting(0.1, "rays' opacity against the masks", least=0)
    metallic: float = setting(
        0.01, "what the mean metallic costs: metal is for where nothing else serves", least=0
    )
    light_smoothness: float = setting(
        0.1, "change of a local light over about a voxel, L1", least=0
    )
    white_light: float = setting(
        0.01,
        "distance of the light from grey on the whole, as a share of it: photographs fix albedo "
        "and light up to a colour only",
        least=0,
    )
    map_smoothness: float = setting(1e-3, "total variation of the log map", least=0)
    patches: float = setting(
        0.4,
        "what patches of the surface lack in correlation between photographs, in every second step",
        least=0,
    )

    __post_init__ = check_settings


@dataclass(frozen=True)
class EntropyConfig:
    """The prior that paint comes in few colours, see training/albedo_entropy.py."""

    teaching_steps: int = setting(
        60, "steps in which the materials learn the albedos under a map that was changed", least=1
    )

    __post_init__ = check_settings


@dataclass(frozen=True)
class JointConfig:
    """The stage that solves for one map, the materials and normals, see training/joint_solve.py."""

    iterations: int = setting(675, "Adam steps in all rounds; fewer when time runs out", least=1)
    share: float = setting(0.27, "of the time budget", above=0, most=1)
    rays: int = setting(2048, "observations per step; at least views")
    views: int = setting(4, "observations of a point per step", least=1)
    rounds: int = setting(4, "of Newton steps on the map and then of Adam", least=1)
    points: int = setting(20400, "on the surface", least=1)
    tracing: int = setting(2, "visibility rays per point and direction", least=1)
    colors: bool = setting(True, "whether the light minimises the entropy of albedo, see entropy")
    only_metal: bool | None = setting(
        None, "whether all is metal, as dark as it looks, and the map neutral; None: trials decide"
    )
    lr_features: float = setting(0.03, "learning rate at the begin of a round", above=0)
    lr_networks: float = setting(
        3e-3,
        "learning rate at the begin of a round: of the materials' head and the views' gains",
        above=0,
    )
    lr_map: float = setting(0.05, "learning rate of the log map", above=0)
    lr_sdf: float = setting(
        0.04, "learning rate of the surface; 0: it stays", unit="voxels per step", least=0
    )
    newton_steps: int = setting(3, "at the begin of a round", least=0)
    newton_points: int = setting(1900, "of the points", least=1)
    newton_views: int = setting(8, "observations of each", least=2)
    newton_smooth: float = setting(
        1e-7, "Laplacian on the log map against the mean squared residual", above=0
    )
    entropy: EntropyConfig = setting(
        EntropyConfig(), "the prior on few colours, where colors is set"
    )

    def __post_init__(self) -> None:
        check_settings(self)
        check_fields(self, "at least views", lambda x: x >= self.views, "rays")


@dataclass(frozen=True)
class TrainConfig:
    """A training."""

    data: Path = field(metadata=about("folder of the data set"))
    out: Path = field(metadata=about("folder of the run"))
    stages: tuple[StageConfig | JointConfig, ...] = field(
        metadata=about(
            "in the order in which they are trained, one at least: a StageConfig first, which "
            "makes the grid"
        )
    )
    minutes: float | None = setting(
        None,
        "wall-clock limit from the first photograph read to the end: what does not fit is cut, in "
        "all stages alike; None: all steps are made, however long they take",
        above=0,
    )
    downscale: int = setting(
        0,
        "pixels of the photographs along a side of one that is trained on; 0: as many as leave "
        "what grids can use, 1 for photographs of 1499 pixels and fewer. A run's config.json has "
        "the number that was found",
        least=0,
    )
    voxel_pixels: float = setting(
        1.0,
        "pixels of the photographs, where the object is, that a voxel is at least as wide as: a "
        "finer grid would only learn their noise",
        least=0,
    )
    seed: int = setting(
        0,
        "of the random numbers of training: first parameters, rays, points. Which rays are held "
        "out does not depend on it",
    )
    masks: MasksFrom = setting(
        "auto",
        "auto: masks that end outside of the object, as the photographs show it, are taken in",
    )
    cameras: CamerasFrom = setting(
        "auto",
        "refined: the photographs' cameras are put right, before training and in it; auto: where "
        "their silhouettes contradict one another",
    )
    exposures: bool = setting(
        True,
        "whether photographs are looked at for exposures that differ; where they do, scene.varying "
        "becomes exposure, of none",
    )
    allow_outside: bool = setting(
        False, "whether what the data set's files and links name may lie outside of its folder"
    )
    light_frame: LightFrameOrAuto = setting(
        "auto",
        "what the light stands still in: the world of the cameras; the room of a turntable, whose "
        "camera stood still too; or the camera, whose flash lights the object beside what stands "
        "around it; auto: what explains best how colours change from photograph to photograph. "
        "scene.turntable then holds the axis, scene.flash the distance",
    )
    detail: Detailing = setting(
        "texture",
        "texture: after training, albedo comes from the photographs at their own size, where they "
        "show more than the grid holds",
    )
    carving_seconds: float = setting(
        12.0,
        "that carving concavities before training may be expected to take on two cores, or they "
        "are left alone: those that no silhouette shows, where photographs agree on them. Never "
        "where their light varies, other than in exposure; 0: never",
        unit="seconds",
        least=0,
    )
    patience: float = setting(
        0.0,
        "that held-out rays must gain in 15 % of a stage, or it is shortened; 0: never",
        unit="dB",
        least=0,
    )
    capacity: Capacity = setting(
        "adaptive", "adaptive: sizes above are limits, see training/compression.py"
    )
    budget_mb: float | None = setting(
        None, "that the model's file may have; adaptive only", unit="1e6 bytes", above=0
    )
    scene: SceneConfig = setting(SceneConfig(), "sizes of the model, and what light it has")
    loss: LossConfig = setting(LossConfig(), "weights in each StageConfig")

    def __post_init__(self) -> None:
        check_settings(self)
        check_fields(self, "a path", lambda x: isinstance(x, Path), "data", "out")
        check_fields(self, "a path in UTF-8", _is_utf8, "data", "out")
        first = "a StageConfig first, which makes the grid"
        check_fields(self, first, lambda x: x and isinstance(x[0], StageConfig), "stages")
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
    write_json(cfg.out / "config.json", values)


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
    since = {"downscale": 1, "voxel_pixels": 0.0}
    began |= {name: value for name, value in since.items() if name not in before}
    now = _as_json(cfg)
    for one in (began, now):
        one["downscale"] = one["downscale"] or 1  # 0 was 1 before it was found
    names = "stages scene downscale voxel_pixels capacity budget_mb masks cameras exposures"
    for name in [*names.split(), "light_frame"]:
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
    result = without_retired(type(now), EARLIER.get(type(now).__name__, {}) | before)
    for known in dataclasses.fields(now):
        if known.name in result:
            result[known.name] = _completed(result[known.name], getattr(now, known.name))
        elif known.name == "kind":  # of a light: files from before there were others do not say
            result["kind"] = "sg"
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
