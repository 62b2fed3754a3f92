"""Configurations: presets, their file, and every range that is checked."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from plain import plain_stage, plain_training

import univoxel
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
from univoxel.errors import UserError
from univoxel.lights import EnvmapConfig, SGConfig
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


def test_what_preset_and_minutes_choose():
    photos, run = Path("photos"), Path("run")
    draft = preset("draft", photos, run, "sg")
    assert chosen("draft", None, photos, run, "sg") == draft
    assert chosen("draft", 7.0, photos, run, "sg") == replace(draft, minutes=7.0)  # a limit
    assert chosen("auto", 7.0, photos, run, "sg") == budget(7.0, photos, run, "sg")
    assert chosen("auto", None, photos, run) == preset("fast", photos, run)


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


def test_presets_differ_in_work():
    presets = [preset(name, Path("a"), Path("b")) for name in PRESETS]
    seconds = [sum(map(expected_seconds, config.stages)) for config in presets]
    assert seconds == sorted(set(seconds))


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
