"""Ranges of the constants of the joint solve."""

from dataclasses import fields, replace

import pytest

from univoxel.config import EntropyConfig, MetalConfig, MirrorConfig


@pytest.mark.parametrize(
    ("config", "change", "message"),
    [
        (MetalConfig(), {"min_reflectance": -0.1}, "min_reflectance must be in .*, got -0.1"),
        (EntropyConfig(), {"teaching_steps": 0}, "teaching_steps must be at least 1, got 0"),
    ],
)
def test_values_out_of_range(config, change, message):
    with pytest.raises(ValueError, match=f"^{type(config).__name__}: .*{message}"):
        replace(config, **change)


@pytest.mark.parametrize("record", [MetalConfig(), MirrorConfig(), EntropyConfig()], ids=str)
def test_every_number_is_checked(record):
    """Not a number is in no range."""
    for f in fields(record):
        with pytest.raises(ValueError, match=f"{type(record).__name__}: {f.name} must be "):
            replace(record, **{f.name: float("nan")})
