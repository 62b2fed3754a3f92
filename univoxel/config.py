"""The whole configuration of a training run, and its presets."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

from univoxel.fields.hashed import PER_LEVEL
from univoxel.files import replacing
from univoxel.lights import (
    EnvmapConfig,
    EnvmapSGConfig,
    LightConfig,
    MLPLightConfig,
    SGConfig,
    SHConfig,
)
from univoxel.scene import SceneConfig

FieldName: TypeAlias = Literal["dense", "sparse", "hash"]
LightName: TypeAlias = Literal["hybrid", "sg", "sh", "mlp", "envmap-sg", "envmap"]
Capacity: TypeAlias = Literal["fixed", "adaptive"]
CamerasFrom: TypeAlias = Literal["auto", "given", "refined"]
MasksFrom: TypeAlias = Literal["auto", "given"]
Differing: TypeAlias = Literal["auto", "none", "exposure", "light"]
LIGHTS: tuple[LightName, ...] = get_args(LightName)


@dataclass(frozen=True)
class StageConfig:
    """One stage of training, on a grid of its own resolution."""

    voxels: float  # millions in the object's box at most, > 0; see TrainConfig.voxel_pixels
    iterations: int  # optimisation steps, >= 1; fewer when time runs out
    share: float  # of the time budget, (0, 1]
    rays: int = 2048  # per step, >= 1
    sharpness: tuple[float, float] = (0.5, 0.5)  # s of the NeuS density at begin and end, voxels
    lr_sdf: tuple[float, float] = (0.2, 0.02)  # at begin and end, voxels per step; all rates > 0
    lr_features: tuple[float, float] = (0.1, 0.01)
    lr_networks: tuple[float, float] = (3e-3, 3e-4)
    lr_poses: tuple[float, float] = (1e-3, 1e-4)  # radians, radii; of cameras that are refined
    plate: float = 0.003  # thin-plate smoothing of touched sdf nodes per step, [0, 0.125]
    spread: int = 4  # passes that smooth the sdf's gradient before the optimiser, >= 0
    diffusion: float = 0.01  # smoothing of touched feature nodes per step, [0, 0.25]
    physical_from: float = 1.0  # progress in [0, 1] at which the physically based render joins
    refit: bool = False  # materials stay; light, radiance and silhouettes follow them
    # sparse: only bricks around the surface are stored; hash: features come from a hash table
    field: FieldName = "dense"

    def __post_init__(self):
        _check(self, "above 0", lambda x: 0 < x < math.inf, "voxels")
        _check(self, "at least 1", lambda x: x >= 1, "iterations", "rays")
        _check(self, "in (0, 1]", lambda x: 0 < x <= 1, "share")
        _check(
            self,
            "two numbers above 0",
            lambda x: len(x) == 2 and all(0 < v < math.inf for v in x),
            *("sharpness", "lr_sdf", "lr_features", "lr_networks", "lr_poses"),
        )
        _check(self, "at least 0", lambda x: x >= 0, "spread")
        _check(self, "in [0, 0.125]", lambda x: 0 <= x <= 0.125, "plate")
        _check(self, "in [0, 0.25]", lambda x: 0 <= x <= 0.25, "diffusion")
        _check(self, "in [0, 1]", lambda x: 0 <= x <= 1, "physical_from")
        _check(self, "dense, sparse or hash", lambda x: x in get_args(FieldName), "field")


@dataclass(frozen=True)
class JointConfig:
    """The stage that solves for one map, the materials and normals, see tasks/joint.py."""

    iterations: int = 700  # Adam steps in all rounds, >= 1; fewer when time runs out
    share: float = 0.4  # of the time budget, (0, 1]
    rays: int = 4096  # sightings per step, >= views
    views: int = 4  # sightings of a point per step, >= 1
    rounds: int = 4  # of Newton steps on the map and then of Adam, >= 1
    points: int = 20000  # on the surface, >= 1
    tracing: int = 2  # visibility rays per point and direction, >= 1
    colors: bool = True  # whether the few colours of paint tell of the light, see solve/palette.py
    lr_features: float = 0.03  # at the begin of a round; all rates > 0
    lr_networks: float = 3e-3
    lr_map: float = 0.05  # of the log map
    lr_sdf: float = 0.04  # of the surface, voxels per step, >= 0; 0: it stays
    albedo_smoothness: float = 0.005  # weights >= 0
    roughness_smoothness: float = 0.02
    metallic: float = 0.01
    newton_steps: int = 3  # at the begin of a round, >= 0
    newton_points: int = 4000  # of the points, >= 1
    newton_views: int = 8  # sightings of each, >= 2
    newton_roughness: float = 0.1  # standard deviation that roughness follows the map with; 0: none
    newton_smooth: float = 1e-7  # Laplacian on the log map against the mean squared residual, > 0

    def __post_init__(self):
        counts = ("iterations", "views", "rounds", "points", "tracing", "newton_points")
        _check(self, "at least 1", lambda x: x >= 1, *counts)
        _check(self, "in (0, 1]", lambda x: 0 < x <= 1, "share")
        _check(self, "at least views", lambda x: x >= self.views, "rays")
        rates = ("lr_features", "lr_networks", "lr_map", "newton_smooth")
        _check(self, "above 0", lambda x: 0 < x < math.inf, *rates)
        weights = ("albedo_smoothness", "roughness_smoothness", "metallic")
        not_below = (*weights, "lr_sdf", "newton_steps", "newton_roughness")
        _check(self, "at least 0", lambda x: 0 <= x < math.inf, *not_below)
        _check(self, "at least 2", lambda x: x >= 2, "newton_views")


@dataclass(frozen=True)
class LossConfig:
    """Weights >= 0 of the losses; the photometric loss of the physically based render has 1."""

    radiance: float = 1.0
    silhouette: float = 0.1
    albedo_smoothness: float = 0.005
    roughness_smoothness: float = 0.02
    metallic: float = 0.01  # what the mean metallic costs: metal is for where nothing else serves
    light_smoothness: float = 0.1
    white_light: float = 0.01
    map_smoothness: float = 1e-3  # total variation of the log map

    def __post_init__(self):
        names = [f.name for f in dataclasses.fields(self)]
        _check(self, "at least 0", lambda x: 0 <= x < math.inf, *names)


@dataclass(frozen=True)
class TrainConfig:
    data: Path  # folder of the data set
    out: Path  # folder of the run
    stages: tuple[StageConfig | JointConfig, ...]
    minutes: float  # > 0; training ends in time, with what it has
    # pixels of the photographs along a side of one that is trained on, >= 1; 0: 1, but large
    # photographs are refused
    downscale: int = 0
    # pixels of the photographs, where the object is, that a voxel is at least as wide as, >= 0: a
    # finer grid would only learn their noise
    voxel_pixels: float = 1.0
    seed: int = 0
    # auto: masks that end outside of the object, as the photographs show it, are taken in
    masks: MasksFrom = "given"
    # refined: the photographs' cameras are put right, before training and in it; auto: where their
    # silhouettes contradict one another
    cameras: CamerasFrom = "given"
    # whether photographs are looked at for exposures that differ; where they do, scene.varying
    # becomes exposure, of none
    exposures: bool = False
    # share of the minutes, >= 0, that opening hollows before training may be expected to take, or
    # they are left alone: hollows that no silhouette shows, where photographs agree on them. Never
    # where their light varies, other than in exposure
    hollows: float = 0.0
    # dB that held-out rays must gain in 15 % of a stage, or it is shortened, >= 0; 0: never
    patience: float = 0.0
    capacity: Capacity = "fixed"  # adaptive: sizes above are limits, see tasks/capacity.py
    budget_mb: float | None = None  # 1e6 bytes that the model's file may have, > 0; adaptive only
    scene: SceneConfig = field(default_factory=SceneConfig)
    loss: LossConfig = field(default_factory=LossConfig)

    def __post_init__(self):
        _check(self, "a path", lambda x: isinstance(x, Path), "data", "out")
        _check(
            self,
            "a StageConfig first, which makes the grid",
            lambda x: len(x) >= 1 and isinstance(x[0], StageConfig),
            "stages",
        )
        kinds = [s.field for s in self.stages if isinstance(s, StageConfig)]
        if "hash" in kinds and set(kinds) != {"hash"}:
            raise ValueError(f"TrainConfig: hash is for all stages or none, got {', '.join(kinds)}")
        if kinds != sorted(kinds):
            raise ValueError(
                f"TrainConfig: no dense stage can follow a sparse one, got {', '.join(kinds)}"
            )
        if "hash" in kinds and self.scene.channels % PER_LEVEL:
            raise ValueError(
                f"TrainConfig: the hash field has {PER_LEVEL} channels a level: scene.channels "
                f"must be a multiple of that, got {self.scene.channels}"
            )
        if self.capacity == "adaptive" and "sparse" in kinds:
            raise ValueError(
                "TrainConfig: adaptive capacity, and so --budget-mb, is for dense and hash fields: "
                "leave it out, or the sparse field"
            )
        if not self.scene.sky_nodes and any(isinstance(s, JointConfig) for s in self.stages):
            raise ValueError(
                "TrainConfig: a JointConfig stage needs scene.sky_nodes above 0, got 0"
            )
        _check(self, "above 0", lambda x: x > 0, "minutes")
        names = ("patience", "downscale", "voxel_pixels", "hollows")
        _check(self, "at least 0", lambda x: 0 <= x < math.inf, *names)
        _check(self, "fixed or adaptive", lambda x: x in get_args(Capacity), "capacity")
        _check(self, "auto or given", lambda x: x in get_args(MasksFrom), "masks")
        _check(self, "auto, given or refined", lambda x: x in get_args(CamerasFrom), "cameras")
        _check(self, "above 0 or None", lambda x: x is None or 0 < x < math.inf, "budget_mb")
        if self.budget_mb is not None and self.capacity == "fixed":
            raise ValueError(
                f"TrainConfig: budget_mb {self.budget_mb:g} needs adaptive capacity, got fixed"
            )


def _check(config: object, wanted: str, holds: Callable[[Any], bool], *names: str) -> None:
    for name in names:
        value = getattr(config, name)
        try:
            held = holds(value)
        except TypeError:
            held = False
        if not held:
            raise ValueError(f"{type(config).__name__}: {name} must be {wanted}, got {value!r}")


def save_config(cfg: TrainConfig) -> None:
    """Write the resolved configuration to config.json in the run's folder, whole or not at all.

    Raises:
        OSError: it cannot be written.
    """
    text = json.dumps(dataclasses.asdict(cfg), indent=2, default=str)
    with replacing(cfg.out / "config.json") as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def check_same(cfg: TrainConfig) -> None:
    """Refuse to go on with the run in cfg.out under stages or a model that it did not begin with.

    Raises:
        ValueError: they differ, or config.json cannot be read.
    """
    path = cfg.out / "config.json"
    try:
        before = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: cannot be read, so the run cannot go on: {error}") from None
    now = json.loads(json.dumps(dataclasses.asdict(cfg), default=str))
    # of configurations from before there were any
    since = {"downscale": 0, "voxel_pixels": 0.0, "capacity": "fixed", "budget_mb": None}
    since |= {"masks": "given", "cameras": "given", "exposures": False}
    for name in ("stages", "scene", *since):
        if not isinstance(before, dict) or before.get(name, since.get(name)) != now[name]:
            raise ValueError(
                f"{path}: the run began with other {name}: resume with the same --preset, "
                "--minutes, --light, --varying, --masks, --cameras, --downscale, --capacity, "
                "--budget-mb and --set as then"
            )


@dataclass(frozen=True)
class Work:
    """What a budget of time on two cores goes into."""

    minutes: float
    voxels: float  # millions, of the finest grid
    steps: float  # of the fine stage; the others follow
    rays: float  # per step


PRESETS = {
    "draft": Work(1.0, voxels=1.0, steps=400, rays=1024),
    "fast": Work(4.0, voxels=2.0, steps=1200, rays=2048),
    "full": Work(12.0, voxels=4.0, steps=4200, rays=2048),
}
COLORS_MINUTES = 1.5  # up to which materials have no time to follow a map that colours changed
HOLLOWS = 0.04  # share of the time: where opening them takes more it costs more than it brings


def preset(
    name: str, data: Path, out: Path, light: LightName = "hybrid", varying: Differing = "auto"
) -> TrainConfig:
    """The configuration of a preset: draft (1 minute), fast (4) or full (12) on two cores.

    Its sizes are limits: capacity is adaptive under the hybrid light, and fixed under others, which
    are there to be compared.

    Args:
        light, varying: see `budget`.

    Raises:
        ValueError: an unknown name, or varying light with a map from the beginning.
    """
    if name not in PRESETS:
        raise ValueError(f"preset must be draft, fast or full, got {name!r}")
    return _configuration(PRESETS[name], data, out, light, varying)


def budget(
    minutes: float, data: Path, out: Path, light: LightName = "hybrid", varying: Differing = "auto"
) -> TrainConfig:
    """The configuration for any time, in minutes on two cores: the presets and what lies between.

    Args:
        minutes: above 0.
        light: "sg", local lobes as published; "hybrid", local lobes while geometry forms, then one
            environment map with traced visibility for the materials, then lobes that follow them;
            "sh" and "mlp", local light of another form; "envmap-sg" and "envmap", one map with
            traced visibility from the beginning. docs/lights.md tells them apart.
        varying: what differs from photograph to photograph: "none"; "exposure", a gain per channel;
            "light", the light itself too; "auto", exposure where they are seen to differ.

    Raises:
        ValueError: minutes out of range, no such light, or varying light with a map from the
            beginning.
    """
    if not 0 < minutes < math.inf:
        raise ValueError(f"minutes must be above 0, got {minutes:g}")
    return _configuration(work_in(minutes), data, out, light, varying)


def chosen(
    name: str,
    minutes: float | None,
    data: Path,
    out: Path,
    light: LightName = "hybrid",
    varying: Differing = "auto",
) -> TrainConfig:
    """A preset within a limit of minutes; or for the name auto, the work that fits into them.

    Without minutes: the preset as it is, fast for auto.
    """
    if name == "auto" and minutes is not None:
        return budget(minutes, data, out, light, varying)
    config = preset("fast" if name == "auto" else name, data, out, light, varying)
    return config if minutes is None else replace(config, minutes=minutes)


def with_field(cfg: TrainConfig, kind: FieldName) -> TrainConfig:
    """The same with stages on such a field; only the first, a coarse one, is dense where the
    others are sparse. Capacity is fixed where they are."""
    stages = [replace(s, field=kind) if isinstance(s, StageConfig) else s for s in cfg.stages]
    if kind == "sparse" and isinstance(stages[0], StageConfig):
        stages[0] = replace(stages[0], field="dense")
    capacity = "fixed" if kind == "sparse" else cfg.capacity
    return replace(cfg, stages=tuple(stages), capacity=capacity)


def work_in(minutes: float) -> Work:
    """Work on the geometric line between the presets on either side of a time.

    Before draft and beyond full the nearest two lead on, except that the grid stays as fine and the
    batch as large as in full: more would want more memory.
    """
    known = list(PRESETS.values())
    k = max(i for i, w in enumerate(known[:-1]) if i == 0 or w.minutes <= minutes)
    low, high = known[k], known[k + 1]
    x = math.log(minutes / low.minutes) / math.log(high.minutes / low.minutes)
    voxels, steps, rays = (
        getattr(low, name) * (getattr(high, name) / getattr(low, name)) ** x
        for name in ("voxels", "steps", "rays")
    )
    return Work(minutes, min(voxels, known[-1].voxels), steps, min(rays, known[-1].rays))


def _configuration(
    work: Work, data: Path, out: Path, light: LightName, varying: Differing
) -> TrainConfig:
    minutes, voxels = work.minutes, round(work.voxels, 3)
    exposures, known = varying == "auto", "none" if varying == "auto" else varying
    steps, rays = max(6, round(work.steps)), max(8, round(work.rays))
    coarse = StageConfig(
        0.9, steps // 2, share=0.15, rays=rays // 2, sharpness=(0.7, 0.35), field="hash"
    )
    fine = StageConfig(
        voxels=voxels,
        iterations=steps,
        share=0.85,
        rays=rays,
        sharpness=(0.5, 0.3),
        lr_sdf=(0.05, 0.005),
        physical_from=0.3,
        field="hash",
    )
    alone: dict[str, LightConfig] = {
        c.kind: c
        for c in (SGConfig(), SHConfig(), MLPLightConfig(), EnvmapSGConfig(), EnvmapConfig())
    }
    match light:
        case "hybrid":
            # Shares are what the stages cost where none is cut
            coarse, fine = replace(coarse, share=0.12), replace(fine, share=0.48)
            # What Newton and tracing cost follows the steps, or little work would be nothing else
            joint = JointConfig(
                iterations=steps,
                share=0.25,
                points=min(25 * steps, 15000 + 6 * steps),
                newton_points=min(4000, 3 * steps),
                colors=minutes > COLORS_MINUTES,
            )
            refit = StageConfig(
                voxels=voxels,
                iterations=steps // 3,
                share=0.15,
                rays=rays,
                sharpness=(0.3, 0.3),
                lr_sdf=(0.015, 0.0015),
                lr_features=(0.01, 0.001),
                plate=0.0,
                diffusion=0.0,
                physical_from=0.0,
                refit=True,
                field="hash",
            )
            scene, loss = SceneConfig(varying=known), LossConfig()
            stages, capacity = (coarse, fine, joint, refit), "adaptive"
        case _ if light in alone:
            scene = SceneConfig(sky_nodes=0, mirrored=False, light=alone[light], varying=known)
            # Lobes that light the materials to the end: what leaves least shading in the albedo
            loss = LossConfig(light_smoothness=1.0) if light == "sg" else LossConfig()
            stages, capacity = (coarse, fine), "fixed"
        case _:
            names = ", ".join(("hybrid", *alone))
            raise ValueError(f"light must be one of {names}, got {light!r}")
    return TrainConfig(
        data,
        out,
        stages,
        minutes,
        masks="auto",
        cameras="auto",
        exposures=exposures,
        hollows=HOLLOWS,
        capacity=capacity,
        scene=scene,
        loss=loss,
    )
