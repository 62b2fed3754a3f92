"""Configurations refuse what is out of range, as the metadata of their fields tells the range."""

import math
import re
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import get_args

import pytest
from plain import plain_stage, plain_training

from univoxel import config, scene
from univoxel.capture.config import CaptureConfig
from univoxel.config import JointConfig, StageConfig, TrainConfig
from univoxel.errors import ConfigError
from univoxel.evaluation.confidence import AdviceConfig
from univoxel.lights import BakedConfig, EnvmapConfig, EnvmapSGConfig, LightConfig
from univoxel.lights.base import MOST_DIRECTIONS
from univoxel.scene import SceneConfig

STAGE = plain_stage(voxels=1.0, iterations=10, share=1.0)
TRAIN = plain_training(Path("photos"), Path("run"), (STAGE,), minutes=1.0)
NO_SKY = SceneConfig(sky_nodes=0)
CLASSES = {
    *(CaptureConfig, AdviceConfig, *get_args(LightConfig)),
    *(kind for module in (config, scene) for kind in vars(module).values() if is_dataclass(kind)),
}
CONFIGS = {
    kind.__name__: {StageConfig: STAGE, TrainConfig: TRAIN}.get(kind) or kind()
    for kind in sorted(CLASSES, key=lambda kind: kind.__name__)
    if kind.__name__.endswith("Config")
}
RANGES = [
    (name, field.name, said)
    for name, config in CONFIGS.items()
    for field in fields(config)
    if (said := field.metadata["setting"]).range
]


def changed(name: str, field: str, value: float) -> object:
    """The class's example with a value there; where there are several, as the last of them."""
    before = getattr(CONFIGS[name], field)
    if isinstance(before, tuple):
        value = (*before[1:], value)
    return replace(CONFIGS[name], **{field: value})


@pytest.mark.parametrize(("name", "field", "said"), RANGES)
def test_a_number_is_held_to_its_range(name, field, said):
    low = said.least if said.above is None else said.above
    below = low - 1 if said.above is None else low
    for value in (math.nan, math.inf, below, said.most + 0.125):
        with pytest.raises(
            ConfigError, match=f"^{name}: {field} must be .*{re.escape(said.range)}"
        ):
            changed(name, field, value)
    for value in (low if said.above is None else low + 0.125, min(said.most, 1024)):
        assert said.range not in refusal(name, field, value)  # maybe by a rule of two fields


def refusal(name: str, field: str, value: float) -> str:
    try:
        changed(name, field, value)
    except ConfigError as error:
        return str(error)
    return ""


def test_every_field_is_explained():
    for one in CONFIGS.values():
        assert all(field.metadata["setting"].meaning for field in fields(one))
    assert len(RANGES) > 80


@pytest.mark.parametrize(
    ("config", "change", "message"),
    [
        (STAGE, {"lr_sdf": (0.1,)}, r"lr_sdf must be two numbers above 0, got \(0.1,\)"),
        (STAGE, {"lr_features": 0.1}, "lr_features must be two numbers above 0, got 0.1"),
        (STAGE, {"sharpness": (0.5, 0.0)}, "sharpness must be two numbers above 0"),
        (STAGE, {"field": "octree"}, "field must be dense, sparse or hash, got 'octree'"),
        (TRAIN, {"data": 42}, "data must be a path, got 42"),
        (TRAIN, {"out": None}, "out must be a path, got None"),
        (TRAIN, {"out": Path("run\udcff")}, "out must be a path in UTF-8, got .*run.udcff"),
        (TRAIN, {"stages": ()}, r"stages must be a tuple whose first stage .*got \(\)"),
        (TRAIN, {"stages": (JointConfig(),)}, "stages must be a tuple whose first"),
        (TRAIN, {"stages": (STAGE, JointConfig()), "scene": NO_SKY}, "scene.sky_nodes above 0"),
        (TRAIN, {"masks": "wide"}, "masks must be auto or given, got 'wide'"),
        (TRAIN, {"cameras": "wrong"}, "cameras must be auto, given or refined, got 'wrong'"),
        (TRAIN, {"capacity": "elastic"}, "capacity must be fixed or adaptive, got 'elastic'"),
        (TRAIN, {"budget_mb": 1.0}, "budget_mb=1 needs capacity=adaptive, got fixed"),
        (TRAIN, {"light_frame": "moon"}, "light_frame must be auto, world, turntable or camera"),
        (JointConfig(), {"rays": 3}, "rays must be at least views, got 3"),
        (SceneConfig(), {"material_channels": 99}, r"at most channels \(16\), got 99"),
        (SceneConfig(), {"sky_rows": 8193}, r"sky_rows must be in \[0, 8192\], got 8193"),
        (SceneConfig(), {"roughness": "rough"}, r"roughness must be None or in \(0, 1\]"),
        (SceneConfig(), {"varying": "all"}, "varying must be none, exposure or light, got 'all'"),
        *(
            (kind(), {name: MOST_DIRECTIONS + 1}, rf"{name} must be in \[1, {MOST_DIRECTIONS}\]")
            for kind in get_args(LightConfig)
            for name in ("directions", "directions_eval")
            if kind is not BakedConfig
        ),
        *(
            (kind(), {"rows": 8193}, r"rows must be in \[1, 8192\]")
            for kind in (EnvmapConfig, EnvmapSGConfig)
        ),
    ],
)
def test_values_that_no_range_tells_of(config, change, message):
    with pytest.raises(ConfigError, match=f"^{type(config).__name__}: .*{message}"):
        replace(config, **change)
