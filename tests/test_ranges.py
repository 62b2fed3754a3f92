"""Configurations refuse what is out of range, as the comments of their fields tell the range."""

import ast
import inspect
import math
import re
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import get_args

import pytest

from univoxel import config, scene
from univoxel.capture.config import CaptureConfig
from univoxel.config import JointConfig, MirrorConfig, StageConfig, TrainConfig
from univoxel.errors import ConfigError
from univoxel.evaluation.confidence import AdviceConfig
from univoxel.lights import BakedConfig, EnvmapConfig, EnvmapSGConfig
from univoxel.lights.base import MOST_DIRECTIONS
from univoxel.scene import LightConfig, SceneConfig

STAGE = StageConfig(voxels=1.0, iterations=10, share=1.0)
TRAIN = TrainConfig(Path("photos"), Path("run"), (STAGE,), minutes=1.0)
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
RANGE = re.compile(r"(>=?) (-?[\d.]+)|([\[(])([\d.]+), ([\d.]+)]")


def comments(kind: type) -> dict[str, str]:
    """What is said of each field, beside it and above."""
    lines, found = inspect.getsource(kind).splitlines(), {}
    for node in ast.parse("\n".join(lines)).body[0].body:
        if isinstance(node, ast.AnnAssign):
            first = node.lineno - 1
            while lines[first - 1].strip().startswith("#"):
                first -= 1
            found[node.target.id] = " ".join(
                re.findall("#(.*)", "\n".join(lines[first : node.end_lineno]))
            )
    return found


def range_of(text: str) -> tuple[float, bool, float] | None:
    """Lower end, whether it is within, and upper end of the range that a text tells of."""
    found = RANGE.search(text)
    if not found:
        return None
    sign, least, bracket, low, high = found.groups()
    low = float(low or least)
    if re.search("; 0: ", text):  # has a meaning of its own
        low = min(low, 0.0)
    return low, sign == ">=" or bracket == "[", float(high or math.inf)


def ranges() -> list[tuple]:
    """Class, field and its range, where its comment, its class or its group of fields has one."""
    found = []
    for name, example in CONFIGS.items():
        texts = comments(type(example))
        rates = "> 0" if "all rates > 0" in " ".join(texts.values()) else ""
        for field in fields(example):
            several = rates if field.name.startswith("lr_") else (type(example).__doc__ or "")
            range = range_of(texts.get(field.name, "")) or range_of(several)
            if range and field.name != "stages":
                found.append((name, field.name, *range))
    return found


def changed(name: str, field: str, value: float) -> object:
    """The class's example with a value there; where there are several, as the first of them."""
    before = getattr(CONFIGS[name], field)
    if isinstance(before, tuple):
        value = (value, *before[1:])
    elif isinstance(before, int) and not math.isnan(value) and value % 1 == 0:
        value = int(value)
    return replace(CONFIGS[name], **{field: value})


@pytest.mark.parametrize(("name", "field", "low", "within", "high"), ranges())
def test_a_number_is_held_to_its_range(name, field, low, within, high):
    above = [] if math.isinf(high) else [high + 0.125]
    for value in (math.nan, low - 1 if within else low, *above):
        with pytest.raises(ConfigError, match=f"^{name}: {field} must be "):
            changed(name, field, value)
    for value in (low if within else low + 0.125, *[high] * len(above)):
        said = refusal(name, field, value)  # maybe by a rule that another field has a part in
        assert not re.search(rf"{field} must be (at least -?\d|above|in)", said)


def refusal(name: str, field: str, value: float) -> str:
    try:
        changed(name, field, value)
    except ConfigError as error:
        return str(error)
    return ""


def test_there_are_ranges():
    assert len(ranges()) > 80


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
        (TRAIN, {"stages": ()}, r"stages must be a StageConfig first, .*got \(\)"),
        (TRAIN, {"stages": (JointConfig(),)}, "stages must be a StageConfig first"),
        (TRAIN, {"stages": (STAGE, JointConfig()), "scene": NO_SKY}, "scene.sky_nodes above 0"),
        (TRAIN, {"masks": "wide"}, "masks must be auto or given, got 'wide'"),
        (TRAIN, {"cameras": "wrong"}, "cameras must be auto, given or refined, got 'wrong'"),
        (TRAIN, {"capacity": "elastic"}, "capacity must be fixed or adaptive, got 'elastic'"),
        (TRAIN, {"budget_mb": 1.0}, "budget_mb 1 needs adaptive capacity, got fixed"),
        (TRAIN, {"light_frame": "moon"}, "light_frame must be auto, world or turntable"),
        (JointConfig(), {"rays": 3}, "rays must be at least views, got 3"),
        (JointConfig(), {"newton_roughness": -1}, "newton_roughness must be at least 0, got -1"),
        (SceneConfig(), {"material_channels": 99}, r"at most channels \(16\), got 99"),
        (SceneConfig(), {"sky_rows": 8193}, r"sky_rows must be in \[0, 8192\], got 8193"),
        (SceneConfig(), {"roughness": "rough"}, r"roughness must be None or in \(0, 1\]"),
        (SceneConfig(), {"varying": "all"}, "varying must be none, exposure or light, got 'all'"),
        (MirrorConfig(), {"rows": 100}, r"rows must be a multiple of 32 in \[0, 1024\], got 100"),
        (MirrorConfig(), {"rows": math.nan}, r"rows must be a multiple of 32 in \[0, 1024\], got"),
        *(
            (kind(), {name: MOST_DIRECTIONS + 1}, f"{name} must be at most {MOST_DIRECTIONS}")
            for kind in get_args(LightConfig)
            for name in ("directions", "directions_eval")
            if kind is not BakedConfig
        ),
        *(
            (kind(), {"rows": 8193}, "rows must be at most 8192")
            for kind in (EnvmapConfig, EnvmapSGConfig)
        ),
    ],
)
def test_values_that_no_range_tells_of(config, change, message):
    with pytest.raises(ConfigError, match=f"^{type(config).__name__}: .*{message}"):
        replace(config, **change)
