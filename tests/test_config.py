"""Configurations: presets, their file, every range that is checked, and fields by --set."""

import json
import math
import re
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import get_args

import pytest
from plain import plain_stage, plain_training

import univoxel
from univoxel import config as configs
from univoxel import scene
from univoxel.capture.config import CaptureConfig
from univoxel.config import (
    PREPARATION,
    JointConfig,
    StageConfig,
    TrainConfig,
    check_same,
    load_config,
    save_config,
)
from univoxel.core.choices import LIGHTS
from univoxel.core.validation import changed
from univoxel.errors import ConfigError, UserError
from univoxel.evaluation.confidence import AdviceConfig
from univoxel.lights import BakedConfig, EnvmapConfig, EnvmapSGConfig, LightConfig, SGConfig
from univoxel.lights.base import MOST_DIRECTIONS
from univoxel.presets import PRESETS, budget, chosen, preset, with_field, with_metal, work_in
from univoxel.scene import SceneConfig
from univoxel.training.clock import expected_seconds

STAGE = plain_stage(voxels=1.0, iterations=10, share=1.0)
CONFIG = plain_training(Path("photos"), Path("run"), (STAGE,), minutes=1.0)


@pytest.mark.parametrize("name", [*PRESETS])
def test_presets(name):
    config = preset(name, Path("photos"), Path("run"))
    assert (config.data, config.out) == (Path("photos"), Path("run"))
    assert sum(stage.share for stage in config.stages) == pytest.approx(1)
    grids = [stage for stage in config.stages if isinstance(stage, StageConfig)]
    voxels = [stage.voxels for stage in grids]
    assert voxels == sorted(voxels)
    assert grids[-1].physical_from < 1  # or materials would never be learned


def test_fine_stages_may_be_sparse():
    config = with_field(preset("fast", Path("photos"), Path("run")), "sparse")
    assert [getattr(s, "field", None) for s in config.stages] == ["dense", "sparse", None, "sparse"]
    assert config.capacity == "fixed"
    with pytest.raises(ValueError, match="adaptive capacity and budget_mb do not work with sparse"):
        replace(config, capacity="adaptive")
    dense = with_field(preset("fast", Path("photos"), Path("run")), "dense")
    assert with_field(config, "dense") == replace(dense, capacity="fixed")
    assert dense.capacity == "adaptive"
    with pytest.raises(ValueError, match=r"dense stages must come before .*, got sparse, d"):
        replace(CONFIG, stages=(replace(STAGE, field="sparse"), STAGE))


def test_all_stages_are_hashed_or_none():
    config = preset("fast", Path("photos"), Path("run"))
    assert with_field(config, "hash") == config
    assert {s.field for s in config.stages if isinstance(s, StageConfig)} == {"hash"}
    assert config.capacity == "adaptive"
    with pytest.raises(
        ValueError, match="all stages or none must have a hash field, got dense, hash"
    ):
        replace(CONFIG, stages=(STAGE, replace(STAGE, field="hash")))
    with pytest.raises(ValueError, match=r"channels must be a multiple of 2, .* got 7"):
        replace(config, scene=SceneConfig(channels=7, material_channels=3))


def test_it_may_be_known_whether_all_is_metal():
    cfg = preset("draft", Path("data"), Path("out"))
    assert with_metal(cfg, "auto") is cfg
    known = [getattr(s, "only_metal", None) for s in with_metal(cfg, "all").stages]
    assert known == [None, None, True, None]
    some = with_metal(cfg, "some").stages[2]
    assert isinstance(some, JointConfig)
    assert some.only_metal is False
    lobes = preset("draft", Path("data"), Path("out"), "sg")
    with pytest.raises(
        UserError, match=r"metal=all needs light=hybrid, .* got light=sg"
    ) as refused:
        with_metal(lobes, "all")
    assert refused.value.arguments == ("metal", "light")


def test_capacity_adapts_unless_lights_are_compared():
    kinds = [preset("fast", Path("a"), Path("b"), light).capacity for light in LIGHTS]
    assert kinds == ["adaptive" if light == "hybrid" else "fixed" for light in LIGHTS]


@pytest.mark.parametrize("light", ["hybrid", "sg", "envmap"])
@pytest.mark.parametrize("name", [*PRESETS])
def test_a_preset_is_a_point_of_the_curve(name, light):
    config = preset(name, Path("photos"), Path("run"), light)
    limit = PRESETS[name].minutes / (1 - PREPARATION)
    found = budget(limit, Path("photos"), Path("run"), light)
    assert (config.minutes, found.minutes) == (None, limit)
    assert found == replace(config, minutes=limit)


def test_little_time_goes_into_neither_colours_nor_patches():
    stages = {m: budget(m, Path("data"), Path("run")).stages for m in (0.5, 1, 1.4, 12)}
    assert {m: s[2].colors for m, s in stages.items()} == {
        0.5: False,
        1: False,
        1.4: True,
        12: True,
    }
    patches = {m: tuple(s[i].patches_from for i in (0, 1, 3)) for m, s in stages.items()}
    assert patches == {0.5: (1, 1, 1), 1: (1, 1, 1), 1.4: (0.2, 0, 1), 12: (0.2, 0, 1)}


@pytest.mark.parametrize("light", ["hybrid", "sg"])
def test_exposures_are_looked_at_unless_it_is_said_what_differs(light):
    found = {
        varying: preset("fast", Path("a"), Path("b"), light, varying)
        for varying in ("auto", "none", "exposure", "light")
    }
    assert {k: c.exposures for k, c in found.items()} == {
        "auto": True,
        "none": False,
        "exposure": False,
        "light": False,
    }
    assert [c.scene.varying for c in found.values()] == ["none", "none", "exposure", "light"]
    assert preset("fast", Path("a"), Path("b"), light) == found["auto"]


def test_more_minutes_are_more_work():
    minutes = [0.05, 0.5, 1.0, 1.3, 1.9, 2.0, 2.1, 4.0, 5.0, 11.0, 12.0, 60.0]
    configs = [budget(m, Path("photos"), Path("run")) for m in minutes]
    assert [c.minutes for c in configs] == minutes
    fine = [c.stages[1] for c in configs]
    for name in ("voxels", "iterations", "rays"):
        values = [getattr(s, name) for s in fine]
        assert values == sorted(values)
    joint, lobes = [c.stages[2] for c in configs], [c.scene.light for c in configs]
    for few, name in ((joint, "iterations"), (joint, "rays"), (lobes, "directions")):
        values = [getattr(x, name) for x in few]
        assert values == sorted(values)
    for name in ("lr_networks", "lr_sdf"):  # few steps want larger ones
        values = [getattr(s, name)[0] for s in fine]
        assert values == sorted(values, reverse=True)
        assert values[-1] == pytest.approx(values[-3])  # only steps grow beyond best
    assert (joint[-1].rays, lobes[-1].directions) == (joint[-3].rays, lobes[-3].directions)
    assert joint[-1].iterations > joint[-3].iterations
    assert len({s.iterations for s in fine}) == len(fine)
    between, low, high = (work_in(m) for m in (2**0.5, 1.0, 2.0))
    assert between.steps == pytest.approx((low.steps * high.steps) ** 0.5)
    assert (fine[-1].voxels, fine[-1].rays) == (fine[-3].voxels, fine[-3].rays)  # memory stays


@pytest.mark.parametrize("minutes", [0.0, -1.0, float("nan"), float("inf")])
def test_no_time_to_work_in(minutes):
    with pytest.raises(ValueError, match=f"minutes must be above 0, got {minutes:g}"):
        budget(minutes, Path("photos"), Path("run"))


@pytest.mark.parametrize("light", ["sg", "sh", "mlp", "envmap-sg", "envmap"])
def test_a_light_alone(light):
    config = preset("draft", Path("photos"), Path("run"), light)
    assert config.scene.light.kind == light
    assert config.scene.sky_nodes == 0
    # lab/notes/lights.md
    assert config.loss.light_smoothness == (1.0 if light == "sg" else 0.1)
    assert all(isinstance(stage, StageConfig) for stage in config.stages)
    assert sum(stage.share for stage in config.stages) == pytest.approx(1)


def test_an_unknown_light():
    with pytest.raises(ValueError, match=r"light must be one of hybrid, sg, .*, got 'candle'"):
        preset("draft", Path("photos"), Path("run"), "candle")


def test_what_preset_and_minutes_choose():
    presets = [preset(name, Path("a"), Path("b")) for name in PRESETS]
    seconds = [sum(map(expected_seconds, config.stages)) for config in presets]
    assert seconds == sorted(set(seconds))
    photos, run = Path("photos"), Path("run")
    draft = preset("draft", photos, run, "sg")
    assert chosen("draft", None, photos, run, "sg") == draft
    assert chosen("draft", 7.0, photos, run, "sg") == replace(draft, minutes=7.0)  # a limit
    assert chosen("auto", 7.0, photos, run, "sg") == budget(7.0, photos, run, "sg")
    assert chosen("auto", None, photos, run) == preset("fast", photos, run)


def test_the_file_holds_every_field(tmp_path):
    config = replace(CONFIG, out=tmp_path, seed=7)
    save_config(config)
    stored = json.loads((tmp_path / "config.json").read_text())
    assert stored["version"] == univoxel.__version__
    assert stored["seed"] == 7
    assert stored["data"] == "photos"
    assert stored["stages"][0]["lr_sdf"] == list(STAGE.lr_sdf)
    assert stored["scene"]["light"]["lobes"] == SGConfig().lobes
    assert stored["scene"]["light"]["kind"] == "sg"
    assert [p.name for p in tmp_path.iterdir()] == ["config.json"]


def saved(tmp_path, cut) -> TrainConfig:
    """The configuration of a run, whose config.json `cut` changes."""
    cfg = preset("draft", tmp_path / "photos", tmp_path)
    save_config(cfg)
    path = tmp_path / "config.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps(cut(content) or content))
    return cfg


def without_newer_fields(content):
    for stage in content["stages"]:
        stage.pop("spread", None)
        stage.pop("tracing", None)
    del content["scene"]["light"]["lobes"]


@pytest.mark.parametrize(
    ("cut", "refusal"),
    [
        (without_newer_fields, ""),
        (lambda c: c["stages"][2].update(tracing=7), "the run was started with another stages"),
        (lambda c: c.update(stages=c["stages"][:3]), "the run was started with another stages"),
        (lambda c: [c], "config.json: expected a JSON object"),
    ],
)
def test_a_run_goes_on_under_its_own_stages_alone(tmp_path, cut, refusal):
    said = ""
    try:
        check_same(saved(tmp_path, cut))
    except UserError as error:
        said = str(error)
    assert refusal in said
    assert bool(said) == bool(refusal)


def test_retired_fields_of_a_file_are_passed_over(tmp_path):
    """Runs of earlier versions are read, and go on."""
    cfg = saved(
        tmp_path,
        lambda content: content.update(preparation={"carving": {"agree": 9.0}}, compression={}),
    )
    check_same(cfg)
    assert load_config(tmp_path / "config.json") == cfg


def test_a_file_that_lacks_fields_has_the_defaults_of_version_0_2(tmp_path):
    text = {
        "data": "a",
        "out": str(tmp_path),
        "stages": [{"voxels": 1, "iterations": 9, "share": 1}],
    }
    (tmp_path / "config.json").write_text(json.dumps(text))
    found = load_config(tmp_path / "config.json")
    assert found.scene.light == SGConfig(directions=128)
    assert found.stages == (plain_stage(1.0, 9, 1.0),)
    expected = plain_training(Path("a"), tmp_path, found.stages, scene=found.scene)
    assert found == replace(expected, voxel_pixels=0.0)  # there was none
    check_same(replace(found, downscale=1))
    with pytest.raises(UserError, match="was started with another scene"):
        check_same(replace(found, scene=SceneConfig(light=EnvmapConfig())))


@pytest.mark.parametrize("light", LIGHTS)
def test_a_configuration_is_read_back_as_it_was_written(tmp_path, light):
    config = preset("draft", Path("photos"), tmp_path, light)
    save_config(config)
    assert load_config(tmp_path / "config.json") == config


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[]", "expected a JSON object of settings"),
        ('{"data": "a"}', "TrainConfig: out is missing"),
        ('{"data": "a", "out": "b", "minutes": 1, "stages": [{"voxels": "many"}]}', "voxels must"),
        ('{"data": "a", "out": "b", "minutes": 1, "stages": [], "sead": 1}', "no field 'sead'"),
        ('{"data": "a", "out": "b", "minutes": true, "stages": []}', "minutes must be"),
        ('{"scene": {"light": {"kind": "lamp"}}}', "light must be one of"),
        ("{", "config.json"),
    ],
)
def test_a_file_that_is_no_configuration(tmp_path, text, message):
    path = tmp_path / "config.json"
    path.write_text(text)
    with pytest.raises(UserError, match=f"config.json.*{re.escape(message)}|{message}") as caught:
        load_config(path)
    assert str(path) in str(caught.value)


NO_SKY = SceneConfig(sky_nodes=0)
CLASSES = {
    *(CaptureConfig, AdviceConfig, *get_args(LightConfig)),
    *(kind for module in (configs, scene) for kind in vars(module).values() if is_dataclass(kind)),
}
CONFIGS = {
    kind.__name__: {StageConfig: STAGE, TrainConfig: CONFIG}.get(kind) or kind()
    for kind in sorted(CLASSES, key=lambda kind: kind.__name__)
    if kind.__name__.endswith("Config")
}
RANGES = [
    (name, field.name, said)
    for name, config in CONFIGS.items()
    for field in fields(config)
    if (said := field.metadata["setting"]).range
]


def with_value(name: str, field: str, value: float) -> object:
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
            with_value(name, field, value)
    for value in (low if said.above is None else low + 0.125, min(said.most, 1024)):
        assert said.range not in refusal(name, field, value)  # maybe by a rule of two fields


def refusal(name: str, field: str, value: float) -> str:
    try:
        with_value(name, field, value)
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
        (CONFIG, {"data": 42}, "data must be a path, got 42"),
        (CONFIG, {"out": None}, "out must be a path, got None"),
        (CONFIG, {"out": Path("run\udcff")}, "out must be a path in UTF-8, got .*run.udcff"),
        (CONFIG, {"stages": ()}, r"stages must be a tuple whose first stage .*got \(\)"),
        (CONFIG, {"stages": (JointConfig(),)}, "stages must be a tuple whose first"),
        (CONFIG, {"stages": (STAGE, JointConfig()), "scene": NO_SKY}, "scene.sky_nodes above 0"),
        (CONFIG, {"masks": "wide"}, "masks must be auto or given, got 'wide'"),
        (CONFIG, {"cameras": "wrong"}, "cameras must be auto, given or refined, got 'wrong'"),
        (CONFIG, {"capacity": "elastic"}, "capacity must be fixed or adaptive, got 'elastic'"),
        (CONFIG, {"budget_mb": 1.0}, "budget_mb=1 needs capacity=adaptive, got fixed"),
        (CONFIG, {"light_frame": "moon"}, "light_frame must be auto, world, turntable or camera"),
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


@pytest.fixture
def fast() -> TrainConfig:
    return preset("fast", Path("photos"), Path("run"))


def test_fields_by_set(fast):
    """Of a stage, of a record in one, and one number of several: earlier command lines work."""
    joint = changed(fast, ["stages.2.newton_steps=2", "stages.2.colors=False"]).stages[2]
    assert joint == replace(fast.stages[2], newton_steps=2, colors=False)
    joint = changed(fast, ["stages.2.entropy.teaching_steps=5"]).stages[2]
    before = fast.stages[2].entropy
    assert before.teaching_steps != 5
    assert joint == replace(fast.stages[2], entropy=replace(before, teaching_steps=5))
    fine = changed(fast, ["stages.1.sharpness.0=0.6"]).stages[1]
    assert fine.sharpness == (0.6, fast.stages[1].sharpness[1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("1.sharpness=(0.0, 0.2)", r"sharpness must be two numbers above 0, got \(0.0, 0.2\)"),
        ("1.sharpness=0.4", "expected a value such as"),
        ("2.entropy.asked=1", "no field 'asked'; the fields are: teaching_steps"),
        ("1.sharpness=('soft', 'sharp')", "sharpness must be two numbers above 0"),
    ],
)
def test_what_makes_no_sense_is_refused(fast, change, message):
    with pytest.raises(ValueError, match=message):
        changed(fast, [f"stages.{change}"])
