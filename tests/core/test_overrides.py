"""Fields of a configuration, however deep, by --set."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from univoxel.config import TrainConfig, save_config
from univoxel.core.validation import changed
from univoxel.presets import preset


@pytest.fixture
def config() -> TrainConfig:
    return preset("fast", Path("photos"), Path("run"))


def test_the_fields_that_a_joint_stage_has_always_had(config):
    """Command lines of before must work."""
    joint = changed(config, ["stages.2.newton_steps=2", "stages.2.colors=False"]).stages[2]
    assert joint == replace(config.stages[2], newton_steps=2, colors=False)


def test_fields_of_a_record_in_a_stage(config):
    joint = changed(config, ["stages.2.entropy.teaching_steps=5"]).stages[2]
    before = config.stages[2].entropy
    assert before.teaching_steps != 5
    assert joint == replace(config.stages[2], entropy=replace(before, teaching_steps=5))


def test_one_number_of_several(config):
    fine = changed(config, ["stages.1.sharpness.0=0.6"]).stages[1]
    assert fine.sharpness == (0.6, config.stages[1].sharpness[1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("1.sharpness=(0.0, 0.2)", r"sharpness must be two numbers above 0, got \(0.0, 0.2\)"),
        ("1.sharpness=0.4", "expected a value such as"),
        ("2.entropy.asked=1", "no field 'asked'; the fields are: teaching_steps"),
        ("1.sharpness=('soft', 'sharp')", "sharpness must be two numbers above 0"),
    ],
)
def test_what_makes_no_sense_is_refused(config, change, message):
    with pytest.raises(ValueError, match=message):
        changed(config, [f"stages.{change}"])


def test_config_json_records_them(config, tmp_path):
    config = changed(replace(config, out=tmp_path), ["stages.1.sharpness=(0.7, 0.2)"])
    save_config(config)
    stages = json.loads((tmp_path / "config.json").read_text())["stages"]
    assert stages[1]["sharpness"] == [0.7, 0.2]
    assert "entropy" in stages[2]
