"""Fields of a configuration, however deep, by --set."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from univoxel.config import TrainConfig, save_config
from univoxel.overrides import changed
from univoxel.presets import preset


@pytest.fixture
def config() -> TrainConfig:
    return preset("fast", Path("photos"), Path("run"))


def test_the_fields_that_a_joint_stage_has_always_had(config):
    """Command lines of before must work."""
    joint = changed(config, ["stages.2.newton_steps=2", "stages.2.colors=False"]).stages[2]
    assert joint == replace(config.stages[2], newton_steps=2, colors=False)


@pytest.mark.parametrize(
    ("record", "name", "text", "value"),
    [
        ("metal", "threshold", "(-0.5, -0.2)", (-0.5, -0.2)),
        ("metal", "roughness", "(0.2, 0.6)", (0.2, 0.6)),
        ("newton", "cauchy", "0.1", 0.1),
        ("entropy", "sun_shares", "(0.5,)", (0.5,)),
        ("entropy", "sun_gain", "1", 1.0),
        ("trials", "points", "50", 50),
        ("adam", "sdf_passes", "0", 0),
        ("surface", "min_points", "100", 100),
    ],
)
def test_the_constants_of_the_joint_solve(config, record, name, text, value):
    joint = changed(config, [f"stages.2.{record}.{name}={text}"]).stages[2]
    before = getattr(config.stages[2], record)
    assert getattr(before, name) != value
    assert joint == replace(config.stages[2], **{record: replace(before, **{name: value})})


def test_one_number_of_several(config):
    joint = changed(config, ["stages.2.metal.threshold.0=-0.6"]).stages[2]
    assert joint.metal.threshold == (-0.6, config.stages[2].metal.threshold[1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("metal.threshold=(0.1, 0.2)", r"threshold must be two numbers below 0, got \(0.1, 0.2\)"),
        ("metal.threshold=-0.4", "expected a tuple such as"),
        ("metal.asked=1", "no field 'asked', there are: metallic_before, roughness"),
        ("entropy.albedo=('coal', 'snow')", "albedo must be two numbers in"),
    ],
)
def test_what_makes_no_sense_is_refused(config, change, message):
    with pytest.raises(ValueError, match=message):
        changed(config, [f"stages.2.{change}"])


def test_config_json_records_them(config, tmp_path):
    config = changed(replace(config, out=tmp_path), ["stages.2.metal.threshold=(-0.5, -0.2)"])
    save_config(config)
    stage = json.loads((tmp_path / "config.json").read_text())["stages"][2]
    assert stage["metal"]["threshold"] == [-0.5, -0.2]
    assert set(stage) >= {"surface", "newton", "metal", "entropy", "trials", "adam"}


@pytest.mark.parametrize(
    ("record", "name", "text", "value"),
    [
        ("masks", "views", "8", 8),
        ("hull", "margin", "0.1", 0.1),
        ("registration", "edge", "(-2.0, -1.0)", (-2.0, -1.0)),
        ("exposures", "min_stops", "1", 1.0),
        ("carving", "agree", "0.7", 0.7),
    ],
)
def test_the_constants_of_preparation(config, tmp_path, record, name, text, value):
    other = replace(changed(config, [f"preparation.{record}.{name}={text}"]), out=tmp_path)
    before = getattr(config.preparation, record)
    assert getattr(other.preparation, record) == replace(before, **{name: value})
    save_config(other)
    held = json.loads((tmp_path / "config.json").read_text())["preparation"][record][name]
    assert held == (list(value) if isinstance(value, tuple) else value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("carving.agree=1.5", r"CarvingConfig: agree must be in \[0, 1\], got 1.5"),
        ("carving.jump=0.001", "CarvingConfig: jump must be at least slope, got 0.001"),
        ("registration.lr=(0.0, 1.0)", "RegistrationConfig: lr must be two numbers above 0"),
        ("masks.ring=(4.0, 1.0)", "MaskConfig: ring must be two numbers, at least 0 and rising"),
        ("hull.box_nodes=4", "HullConfig: box_nodes must be at least 8, got 4"),
        ("exposures.prior=0.0", "ExposureConfig: prior must be above 0, got 0.0"),
    ],
)
def test_ranges_of_preparation(config, change, message):
    with pytest.raises(ValueError, match=message):
        changed(config, [f"preparation.{change}"])
