"""The complete configuration of a training, and its file."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path

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
from univoxel.core.validation import about, check_fields, check_settings, record, setting
from univoxel.errors import ConfigError, MissingFile, UserError
from univoxel.fields.field import PER_LEVEL
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
    """A stage of training at one grid resolution. Pairs are values at the start and the end."""

    voxels: float = field(
        metadata=about(
            "maximum number of grid voxels; voxel_pixels may lower it", unit="millions", above=0
        )
    )
    iterations: int = field(metadata=about("number of steps; fewer run if time runs out", least=1))
    share: float = field(metadata=about("weight of this stage in the time limit", above=0, most=1))
    rays: int = setting(2048, "rays per step", least=1)
    sharpness: tuple[float, float] = setting(
        (0.5, 0.3), "width s of the NeuS density at the start and the end", unit="voxels", above=0
    )
    lr_sdf: tuple[float, float] = setting(
        (0.07, 0.005), "learning rate of the signed distances", unit="voxels per step", above=0
    )
    lr_features: tuple[float, float] = setting(
        (0.1, 0.01), "learning rate of features and of the table of reflected directions", above=0
    )
    lr_networks: tuple[float, float] = setting(
        (6e-3, 3e-4), "learning rate of networks, light and per-view parameters", above=0
    )
    plate: float = setting(
        0.003, "thin-plate smoothing of the sdf nodes that a step updates", least=0, most=0.125
    )
    spread: int = setting(4, "number of smoothing passes over the gradient of the sdf", least=0)
    diffusion: float = setting(
        0.01, "smoothing of the feature nodes that a step updates", least=0, most=0.25
    )
    physical_from: float = setting(
        0.3, "share of the steps after which physically based rendering is added", least=0, most=1
    )
    patches_from: float = setting(
        0.0, "share of the steps after which the loss `patches` is added", least=0, most=1
    )
    refit: bool = setting(False, "whether to freeze materials and fit light, radiance and shape")
    field: FieldName = setting(
        "hash", "where features are stored: every grid node, bricks at the surface, or a hash table"
    )

    __post_init__ = check_settings


@dataclass(frozen=True)
class LossConfig:
    """Weights of the losses, relative to the photometric loss of the physically based render."""

    radiance: float = setting(1.0, "photometric loss of the radiance head's render", least=0)
    silhouette: float = setting(0.1, "difference between ray opacity and masks", least=0)
    metallic: float = setting(0.01, "penalty on the mean metallic value", least=0)
    light_smoothness: float = setting(
        0.1, "L1 norm of the difference in local light between neighbouring voxels", least=0
    )
    white_light: float = setting(0.01, "relative difference of the mean light from grey", least=0)
    map_smoothness: float = setting(1e-3, "total variation of the log environment map", least=0)
    patches: float = setting(
        0.4, "1 - correlation of patches across photographs; added in every second step", least=0
    )

    __post_init__ = check_settings


@dataclass(frozen=True)
class EntropyConfig:
    """The prior that an object has few albedo colours, see training/albedo_entropy.py."""

    teaching_steps: int = setting(
        60, "number of steps that train the material head to predict the new albedos", least=1
    )

    __post_init__ = check_settings


@dataclass(frozen=True)
class JointConfig:
    """Joint optimisation of one environment map, materials and normals: training/joint_solve.py."""

    iterations: int = setting(675, "total number of Adam steps; fewer if time runs out", least=1)
    share: float = setting(0.27, "weight of this stage in the time limit", above=0, most=1)
    rays: int = setting(2048, "number of observations per step; at least the value of views")
    views: int = setting(4, "number of observations of each point per step", least=1)
    rounds: int = setting(4, "rounds, each of Newton steps on the map and then Adam steps", least=1)
    points: int = setting(20400, "number of surface points", least=1)
    tracing: int = setting(2, "visibility rays per point and direction", least=1)
    colors: bool = setting(True, "whether to minimise the entropy of the albedo")
    only_metal: bool | None = setting(
        None, "whether the whole object is metal; None: a multi-start initialisation decides"
    )
    lr_features: float = setting(0.03, "learning rate of features at the start of a round", above=0)
    lr_networks: float = setting(
        3e-3, "learning rate of the material head and the gains at the start of a round", above=0
    )
    lr_map: float = setting(0.05, "learning rate of the log environment map", above=0)
    lr_sdf: float = setting(
        0.04, "learning rate of the surface; 0: frozen", unit="voxels per step", least=0
    )
    newton_steps: int = setting(3, "number of Newton steps at the start of a round", least=0)
    newton_points: int = setting(1900, "number of points in a Newton step", least=1)
    newton_views: int = setting(8, "number of observations of each point in a Newton step", least=2)
    newton_smooth: float = setting(
        1e-7, "weight of the log map's Laplacian, relative to the mean squared residual", above=0
    )
    entropy: EntropyConfig = setting(EntropyConfig(), "prior that prefers few albedo colours")

    def __post_init__(self) -> None:
        check_settings(self)
        check_fields(self, "at least views", lambda x: x >= self.views, "rays")


@dataclass(frozen=True)
class TrainConfig:
    """The complete configuration of a training run."""

    data: Path = field(metadata=about("folder of the data set"))
    out: Path = field(metadata=about("folder of the run"))
    stages: tuple[StageConfig | JointConfig, ...] = field(
        metadata=about("stages in order; the first is a StageConfig, which creates the grid")
    )
    minutes: float | None = setting(
        None, "time limit, including preparation; stages run fewer steps if it is short", above=0
    )
    downscale: int = setting(
        0, "train at 1/N of the photographs' size; 0: longer side of about 1000 pixels", least=0
    )
    voxel_pixels: float = setting(
        1.0, "minimum width of a voxel at the object, in pixels of the photographs", least=0
    )
    seed: int = setting(0, "random seed; it does not change the validation pixels")
    masks: MasksFrom = setting("auto", "auto: erode masks that extend past the object's edge")
    cameras: CamerasFrom = setting(
        "auto", "refined: optimise camera poses; auto: do so if silhouettes are inconsistent"
    )
    exposures: bool = setting(
        True, "whether to detect varying exposure and light; the result sets scene.varying"
    )
    allow_outside: bool = setting(
        False, "also read files outside the folder if the data set refers to them"
    )
    light_frame: LightFrameOrAuto = setting(
        "auto",
        "world: the light is fixed; turntable: it moves with the camera, see scene.turntable; "
        "camera: a flash, see scene.flash; auto: whichever explains the colour changes best",
    )
    detail: Detailing = setting(
        "texture", "texture: refine the albedo from full-size photographs after training"
    )
    carving_seconds: float = setting(
        12.0,
        "skip carving if it would take longer than this on two cores, or if the light varies",
        unit="seconds",
        least=0,
    )
    patience: float = setting(
        0.0,
        "end a stage if validation PSNR rises by less than this over 15 % of its steps; 0: never",
        unit="dB",
        least=0,
    )
    capacity: Capacity = setting("adaptive", "adaptive: shrink the model with little loss of PSNR")
    budget_mb: float | None = setting(
        None, "maximum size of the model file; needs capacity=adaptive", unit="1e6 bytes", above=0
    )
    scene: SceneConfig = setting(SceneConfig(), "sizes of the model, and its lighting model")
    loss: LossConfig = setting(LossConfig(), "weights of the losses in stages of type StageConfig")

    def __post_init__(self) -> None:
        check_settings(self)
        check_fields(self, "a path", lambda x: isinstance(x, Path), "data", "out")
        # Other names can be made, but not every library opens such files
        check_fields(self, "a path in UTF-8", lambda x: bool(str(x).encode()), "data", "out")
        first = "a tuple whose first stage is a StageConfig, which creates the grid"
        check_fields(self, first, lambda x: x and isinstance(x[0], StageConfig), "stages")
        kinds = [s.field for s in self.stages if isinstance(s, StageConfig)]
        if "hash" in kinds and set(kinds) != {"hash"}:
            raise ConfigError(
                f"TrainConfig: all stages or none must have a hash field, got {', '.join(kinds)}"
            )
        if kinds != sorted(kinds):
            raise ConfigError(
                f"TrainConfig: dense stages must come before sparse ones, got {', '.join(kinds)}"
            )
        if "hash" in kinds and self.scene.channels % PER_LEVEL:
            raise ConfigError(
                f"TrainConfig: scene.channels must be a multiple of {PER_LEVEL}, the number of "
                f"channels per level of a hash field, got {self.scene.channels}"
            )
        if self.capacity == "adaptive" and "sparse" in kinds:
            raise ConfigError(
                "TrainConfig: adaptive capacity and budget_mb do not work with sparse fields: "
                "use another field, or fixed capacity without a budget",
                "budget_mb",
            )
        if not self.scene.sky_nodes and any(isinstance(s, JointConfig) for s in self.stages):
            raise ConfigError(
                "TrainConfig: a stage of type JointConfig needs scene.sky_nodes above 0, got 0"
            )
        if self.budget_mb is not None and self.capacity == "fixed":
            raise ConfigError(
                f"TrainConfig: budget_mb={self.budget_mb:g} needs capacity=adaptive, got fixed"
            )


def save_config(cfg: TrainConfig) -> None:
    """Write the resolved configuration to config.json in the run's folder, atomically.

    The version of the package comes first, because it determines all other constants.
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
        raise MissingFile(f"{path}: expected a configuration, such as the config.json of a run")
    values = read_json(path)
    try:
        if not isinstance(values, dict):
            raise ConfigError(f"expected a JSON object of settings, got {values!r:.60}")
        values = {name: value for name, value in values.items() if name != "version"}
        values.setdefault("voxel_pixels", 0.0)  # configurations from before there were any
        if isinstance(values.get("scene"), dict):
            values["scene"] = dict(values["scene"])
            values["scene"]["light"] = read_config(values["scene"].get("light", {}))
        return record(TrainConfig, values)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def check_same(cfg: TrainConfig) -> None:
    """Refuse, by a UserError, to resume the run in cfg.out with other stages or another model."""
    path = cfg.out / "config.json"
    try:
        before = load_config(path)
    except (OSError, UserError) as error:
        raise UserError(f"{path}: this run cannot be resumed: {error}") from None
    # 0 was 1 before it was found
    before, now = (dataclasses.replace(c, downscale=c.downscale or 1) for c in (before, cfg))
    names = "stages scene downscale voxel_pixels capacity budget_mb masks cameras exposures"
    for name in [*names.split(), "light_frame"]:
        if getattr(before, name) != getattr(now, name):
            raise UserError(
                f"{path}: the run was started with another {name}: to resume it, pass the same "
                f"{', '.join(CHOICES[:-1])} and {CHOICES[-1]} as before",
                *CHOICES,
            )
