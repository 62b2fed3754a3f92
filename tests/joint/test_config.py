"""Ranges of the constants of the joint solve."""

from dataclasses import fields, is_dataclass, replace

import pytest

from univoxel.joint.config import (
    AdamConfig,
    EntropyConfig,
    JointConfig,
    MetalConfig,
    MirrorConfig,
    NewtonConfig,
    SurfaceConfig,
    TrialConfig,
)


@pytest.mark.parametrize(
    ("config", "change", "message"),
    [
        (SurfaceConfig(), {"min_points": 0}, "min_points must be at least 1, got 0"),
        (SurfaceConfig(), {"vertices": 0}, "vertices must be at least 1, got 0"),
        (NewtonConfig(), {"min_views": 1}, "min_views must be at least 2, got 1"),
        (NewtonConfig(), {"min_parts": 0}, "min_parts must be at least 1, got 0"),
        (NewtonConfig(), {"neighbours": 0}, "neighbours must be at least 1, got 0"),
        (NewtonConfig(), {"cauchy": 0.0}, "cauchy must be above 0, got 0.0"),
        (NewtonConfig(), {"noise": float("inf")}, "noise must be above 0, got inf"),
        (NewtonConfig(), {"max_map_change": -1.0}, "max_map_change must be above 0, got -1.0"),
        (NewtonConfig(), {"min_log_albedo": 0.5}, "min_log_albedo must be at most 0, got 0.5"),
        (MetalConfig(), {"metallic_before": 1.5}, "metallic_before must be in .*, got 1.5"),
        (MetalConfig(), {"min_reflectance": -0.1}, "min_reflectance must be in .*, got -0.1"),
        (MetalConfig(), {"only_metal_albedo": 1.0}, "only_metal_albedo must be in .*, got 1.0"),
        (MetalConfig(), {"roughness": ()}, r"roughness must be numbers in .*, got \(\)"),
        (MetalConfig(), {"roughness": (0.0,)}, r"roughness must be numbers in .*, got \(0.0,\)"),
        (MetalConfig(), {"steps": 0}, "steps must be at least 1, got 0"),
        (MetalConfig(), {"base": (1.0, 0.5)}, r"base must be two numbers in .*, rising, got \(1.0"),
        (MetalConfig(), {"near": 0.0}, "near must be above 0, got 0.0"),
        (MetalConfig(), {"threshold": (-0.4,)}, "threshold must be two numbers below 0"),
        (MetalConfig(), {"threshold": (-0.4, 0.0)}, "threshold must be two numbers below 0"),
        (MirrorConfig(), {"voters": 0}, "voters must be at least 1, got 0"),
        (MirrorConfig(), {"flat": 1.5}, "flat must be in .*, got 1.5"),
        (MirrorConfig(), {"change": -1.0}, "change must be at least 0, got -1.0"),
        (MirrorConfig(), {"turn": 0.0}, "turn must be above 0, got 0.0"),
        (MirrorConfig(), {"reflected": 0.0}, "reflected must be in .*, got 0.0"),
        (MirrorConfig(), {"reflected_at_most": 0.5}, "reflected_at_most must be .*, got 0.5"),
        (EntropyConfig(), {"points": 0}, "points must be at least 1, got 0"),
        (EntropyConfig(), {"min_paint": 2.0}, "min_paint must be in .*, got 2.0"),
        (EntropyConfig(), {"min_sky": 0.0}, "min_sky must be in .*, got 0.0"),
        (EntropyConfig(), {"cell": 0.0}, "cell must be above 0, got 0.0"),
        (EntropyConfig(), {"sun_shares": (1.0,)}, "sun_shares must be numbers in .*, got"),
        (EntropyConfig(), {"sun_gain": -1.0}, "sun_gain must be at least 0, got -1.0"),
        (EntropyConfig(), {"steps": (0.0,)}, r"steps must be numbers above 0, got \(0.0,\)"),
        (EntropyConfig(), {"albedo": (0.5, 0.5)}, "albedo must be two numbers in .*, rising, got"),
        (EntropyConfig(), {"teaching_steps": 0}, "teaching_steps must be at least 1, got 0"),
        (TrialConfig(), {"points": 0}, "points must be at least 1, got 0"),
        (TrialConfig(), {"only_metal": 0.0}, "only_metal must be above 0, got 0.0"),
        (TrialConfig(), {"like_paint": 1.5}, "like_paint must be in .*, got 1.5"),
        (TrialConfig(), {"roughness": (1.0,)}, r"roughness must be numbers in .*, got \(1.0,\)"),
        (TrialConfig(), {"better": 0.0}, "better must be in .*, got 0.0"),
        (TrialConfig(), {"majority": -0.1}, "majority must be in .*, got -0.1"),
        (AdamConfig(), {"decay": 0.0}, "decay must be in .*, got 0.0"),
        (AdamConfig(), {"sdf_passes": -1}, "sdf_passes must be at least 0, got -1"),
        (AdamConfig(), {"surface": -1.0}, "surface must be at least 0, got -1.0"),
        (AdamConfig(), {"beside": 0.0}, "beside must be above 0, got 0.0"),
    ],
)
def test_values_out_of_range(config, change, message):
    with pytest.raises(ValueError, match=f"^{type(config).__name__}: .*{message}"):
        replace(config, **change)


def records() -> list:
    joint = JointConfig()
    values = (getattr(joint, f.name) for f in fields(joint))
    return [value for value in values if is_dataclass(value)]


@pytest.mark.parametrize("record", records(), ids=lambda record: type(record).__name__)
def test_every_number_is_checked(record):
    """Not a number is in no range."""
    for f in fields(record):
        value = getattr(record, f.name)
        wrong = (float("nan"),) * len(value) if isinstance(value, tuple) else float("nan")
        with pytest.raises(ValueError, match=f"{type(record).__name__}: {f.name} must be "):
            replace(record, **{f.name: wrong})


def test_rounds_are_what_the_trials_cost():
    """For metal and for none: the present roughness, the others, and one round of what is found."""
    assert TrialConfig(roughness=(0.2, 0.4, 0.6)).rounds == 2 * (1 + 3 + 1)
