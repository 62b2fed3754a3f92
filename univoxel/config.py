"""The whole configuration of a training run, and its file."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

from univoxel import __version__
from univoxel.confidence.config import ConfidenceConfig
from univoxel.errors import ConfigError, MissingFile, UserError
from univoxel.fields.features import PER_LEVEL
from univoxel.files import read_json, replacing
from univoxel.joint.config import JointConfig
from univoxel.lights import read_config
from univoxel.names import CamerasFrom, Capacity, LightFrameOrAuto, MasksFrom
from univoxel.retired import without_retired
from univoxel.scene import SceneConfig
from univoxel.training.config import LossConfig, StageConfig
from univoxel.validation import check_fields, record

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
    ),
    *("budget_mb", "changes"),
)


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
    # seconds, >= 0, that carving concavities before training may be expected to take on two cores,
    # or they are left alone: those that no silhouette shows, where photographs agree on them. Never
    # where their light varies, other than in exposure; 0: never
    carving_seconds: float = 0.0
    # dB that held-out rays must gain in 15 % of a stage, or it is shortened, >= 0; 0: never
    patience: float = 0.0
    capacity: Capacity = "fixed"  # adaptive: sizes above are limits, see compression/plan.py
    budget_mb: float | None = None  # 1e6 bytes that the model's file may have, > 0; adaptive only
    # sizes of the model, and what light it has
    scene: SceneConfig = field(default_factory=SceneConfig)
    loss: LossConfig = field(default_factory=LossConfig)  # weights in each StageConfig
    # what is said of the scene afterwards; evaluation reads it from the run's config.json
    confidence: ConfidenceConfig = field(default_factory=ConfidenceConfig)

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
