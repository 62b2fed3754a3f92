"""Configurations: presets, their file, and every range that is checked."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

import univoxel
from univoxel.config import (
    PREPARATION,
    JointConfig,
    LossConfig,
    MirrorConfig,
    StageConfig,
    TrainConfig,
    check_same,
    load_config,
    save_config,
)
from univoxel.errors import ConfigError, MissingFile, UserError
from univoxel.lights.sg import SGConfig
from univoxel.names import LIGHTS
from univoxel.presets import PRESETS, budget, chosen, preset, with_field, with_metal, work_in
from univoxel.scene import SceneConfig
from univoxel.training.clock import expected_seconds

STAGE = StageConfig(voxels=1.0, iterations=10, share=1.0)
CONFIG = TrainConfig(Path("photos"), Path("run"), (STAGE,), minutes=1.0)


@pytest.mark.parametrize("name", [*PRESETS])
def test_presets(name):
    config = preset(name, Path("photos"), Path("run"))
    assert (config.data, config.out) == (Path("photos"), Path("run"))
    assert sum(stage.share for stage in config.stages) == pytest.approx(1)
    grids = [stage for stage in config.stages if isinstance(stage, StageConfig)]
    voxels = [stage.voxels for stage in grids]
    assert voxels == sorted(voxels)
    assert grids[-1].physical_from < 1  # or materials would never be learned


@pytest.mark.parametrize("field", ["data", "out"])
def test_names_of_folders_that_files_cannot_hold(field):
    with pytest.raises(ConfigError, match=rf"{field} must be a path in UTF-8, got .*run.udcff"):
        replace(CONFIG, **{field: Path("run\udcff")})


def test_fine_stages_may_be_sparse():
    config = with_field(preset("fast", Path("photos"), Path("run")), "sparse")
    assert [getattr(s, "field", None) for s in config.stages] == ["dense", "sparse", None, "sparse"]
    assert config.capacity == "fixed"
    with pytest.raises(ValueError, match="adaptive capacity, and so budget_mb, is for dense"):
        replace(config, capacity="adaptive")
    dense = with_field(preset("fast", Path("photos"), Path("run")), "dense")
    assert with_field(config, "dense") == replace(dense, capacity="fixed")
    assert dense.capacity == "adaptive"
    with pytest.raises(ValueError, match="no dense stage can follow a sparse one, got sparse, d"):
        replace(CONFIG, stages=(replace(STAGE, field="sparse"), STAGE))


def test_all_stages_are_hashed_or_none():
    config = preset("fast", Path("photos"), Path("run"))
    assert with_field(config, "hash") == config
    assert {s.field for s in config.stages if isinstance(s, StageConfig)} == {"hash"}
    assert config.capacity == "adaptive"
    with pytest.raises(ValueError, match="hash is for all stages or none, got dense, hash"):
        replace(CONFIG, stages=(STAGE, replace(STAGE, field="hash")))
    with pytest.raises(ValueError, match=r"scene.channels must be a multiple of that, got 7"):
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
    with pytest.raises(UserError, match=r"metal=all is for light=hybrid, .* got sg") as refused:
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
def test_presets_carve_where_it_takes_a_small_share_of_their_time(light):
    seconds = preset("fast", Path("a"), Path("b"), light).carving_seconds
    assert seconds == pytest.approx(0.1 * 60 * PRESETS["fast"].minutes)


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
    # docs/research/lights.md
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


@pytest.mark.parametrize(
    ("config", "change", "message"),
    [
        (STAGE, {"voxels": 0.0}, "voxels must be above 0, got 0.0"),
        (STAGE, {"voxels": float("nan")}, "voxels must be above 0, got nan"),
        (STAGE, {"iterations": 0}, "iterations must be at least 1, got 0"),
        (STAGE, {"rays": -1}, "rays must be at least 1, got -1"),
        (STAGE, {"share": 0.0}, r"share must be in \(0, 1\], got 0.0"),
        (STAGE, {"sharpness": (0.5, 0.0)}, "sharpness must be two numbers above 0"),
        (STAGE, {"lr_sdf": (0.1,)}, r"lr_sdf must be two numbers above 0, got \(0.1,\)"),
        (STAGE, {"lr_features": 0.1}, "lr_features must be two numbers above 0, got 0.1"),
        (STAGE, {"lr_networks": (-1.0, 1.0)}, "lr_networks must be two numbers above 0"),
        (STAGE, {"plate": 0.2}, r"plate must be in \[0, 0.125\], got 0.2"),
        (STAGE, {"spread": -1}, "spread must be at least 0, got -1"),
        (STAGE, {"diffusion": -0.1}, r"diffusion must be in \[0, 0.25\], got -0.1"),
        (STAGE, {"diffusion": 0.3}, r"diffusion must be in \[0, 0.25\], got 0.3"),
        (STAGE, {"field": "octree"}, "field must be dense, sparse or hash, got 'octree'"),
        (STAGE, {"physical_from": 2.0}, r"physical_from must be in \[0, 1\], got 2.0"),
        (LossConfig(), {"silhouette": -1.0}, "silhouette must be at least 0, got -1.0"),
        (LossConfig(), {"map_smoothness": -1.0}, "map_smoothness must be at least 0, got -1.0"),
        (CONFIG, {"data": 42}, "data must be a path, got 42"),
        (CONFIG, {"out": None}, "out must be a path, got None"),
        (CONFIG, {"stages": ()}, r"stages must be a StageConfig first, .*got \(\)"),
        (CONFIG, {"stages": (JointConfig(),)}, "stages must be a StageConfig first"),
        (
            CONFIG,
            {"stages": (STAGE, JointConfig()), "scene": SceneConfig(sky_nodes=0)},
            "sky_nodes",
        ),
        (JointConfig(), {"rounds": 0}, "rounds must be at least 1, got 0"),
        (JointConfig(), {"rays": 3}, "rays must be at least views, got 3"),
        (JointConfig(), {"lr_map": 0.0}, "lr_map must be above 0, got 0.0"),
        (JointConfig(), {"newton_steps": -1}, "newton_steps must be at least 0, got -1"),
        (JointConfig(), {"lr_sdf": -0.1}, "lr_sdf must be at least 0, got -0.1"),
        (JointConfig(), {"newton_roughness": -1}, "newton_roughness must be at least 0, got -1"),
        (JointConfig(), {"newton_views": 1}, "newton_views must be at least 2, got 1"),
        (CONFIG, {"patience": -0.1}, "patience must be at least 0, got -0.1"),
        (CONFIG, {"downscale": -1}, "downscale must be at least 0, got -1"),
        (CONFIG, {"voxel_pixels": -1}, "voxel_pixels must be at least 0, got -1"),
        (CONFIG, {"carving_seconds": -0.1}, "carving_seconds must be at least 0, got -0.1"),
        (CONFIG, {"minutes": 0.0}, "minutes must be above 0 or None, got 0.0"),
        (CONFIG, {"masks": "wide"}, "masks must be auto or given, got 'wide'"),
        (CONFIG, {"cameras": "wrong"}, "cameras must be auto, given or refined, got 'wrong'"),
        (SceneConfig(), {"channels": 0}, "channels must be at least 1, got 0"),
        (SceneConfig(), {"hidden": 0}, "hidden must be at least 1, got 0"),
        (SceneConfig(), {"material_channels": 99}, r"at most channels \(16\), got 99"),
        (SceneConfig(), {"mirror_levels": -1}, r"mirror_levels must be in \[0, 8\], got -1"),
        (SceneConfig(), {"mirror_levels": 9}, r"mirror_levels must be in \[0, 8\], got 9"),
        (SceneConfig(), {"sky_rows": -1}, r"sky_rows must be in \[0, 8192\], got -1"),
        (MirrorConfig(), {"rows": 100}, r"rows must be a multiple of 32 in \[0, 1024\], got 100"),
    ],
)
def test_values_out_of_range(config, change, message):
    with pytest.raises(ValueError, match=f"^{type(config).__name__}: .*{message}"):
        replace(config, **change)


def test_a_light_is_checked_as_soon_as_it_is_described():
    with pytest.raises(ValueError, match="SGConfig: lobes must be at least 1, got 0"):
        SGConfig(lobes=0)


def saved(tmp_path, cut) -> TrainConfig:
    """The configuration of a run, whose config.json `cut` changes."""
    cfg = preset("draft", tmp_path / "photos", tmp_path)
    save_config(cfg)
    path = tmp_path / "config.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps(cut(content) or content))
    return cfg


def test_a_run_goes_on_whose_file_lacks_fields_that_came_since(tmp_path):
    def cut(content):
        for stage in content["stages"]:
            stage.pop("spread", None)
            stage.pop("tracing", None)
        del content["scene"]["light"]["lobes"]

    check_same(saved(tmp_path, cut))


def test_a_run_does_not_go_on_under_other_stages(tmp_path):
    cfg = saved(tmp_path, lambda content: content["stages"][2].update(tracing=7))
    with pytest.raises(ValueError, match="the run began with other stages"):
        check_same(cfg)


def test_a_run_does_not_go_on_with_more_stages(tmp_path):
    cfg = saved(tmp_path, lambda content: content.update(stages=content["stages"][:3]))
    with pytest.raises(ValueError, match="the run began with other stages"):
        check_same(cfg)


def test_a_file_that_holds_no_configuration(tmp_path):
    with pytest.raises(ValueError, match=r"config\.json: expected an object"):
        check_same(saved(tmp_path, lambda content: [content]))


def test_retired_fields_of_a_file_are_passed_over(tmp_path):
    """Runs of earlier versions are read, and go on."""
    cfg = saved(
        tmp_path,
        lambda content: content.update(preparation={"carving": {"agree": 9.0}}, compression={}),
    )
    check_same(cfg)
    assert load_config(tmp_path / "config.json") == cfg


@pytest.mark.parametrize("light", LIGHTS)
def test_a_configuration_is_read_back_as_it_was_written(tmp_path, light):
    config = preset("draft", Path("photos"), tmp_path, light)
    save_config(config)
    assert load_config(tmp_path / "config.json") == config


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[]", "expected an object with the configuration"),
        ('{"data": "a"}', "TrainConfig: out is missing"),
        ('{"data": "a", "out": "b", "minutes": 1, "stages": [{"voxels": "many"}]}', "voxels must"),
        ('{"data": "a", "out": "b", "minutes": 1, "stages": [], "sead": 1}', "no field 'sead'"),
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


def test_a_configuration_that_is_not_there(tmp_path):
    with pytest.raises(MissingFile, match="expected a configuration"):
        load_config(tmp_path / "config.json")
