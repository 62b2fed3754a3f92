"""Fields of a configuration, however deep, by --set."""

from dataclasses import replace
from pathlib import Path

import pytest

from univoxel.config import TrainConfig
from univoxel.overrides import changed
from univoxel.presets import preset


@pytest.fixture
def config() -> TrainConfig:
    return preset("fast", Path("photos"), Path("run"))


def test_the_fields_that_a_joint_stage_has_always_had(config):
    """Command lines of before must work."""
    joint = changed(config, ["stages.2.newton_steps=2", "stages.2.colors=False"]).stages[2]
    assert joint == replace(config.stages[2], newton_steps=2, colors=False)
