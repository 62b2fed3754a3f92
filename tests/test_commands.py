"""Lights and the ground as the command line writes them; the package's functions."""

import pytest

from univoxel.cli.relight import parse_ground, point_light, sun_light


def test_suns_and_points():
    sun = sun_light((90.0, 30.0, 3.0))
    assert sun.direction == pytest.approx((0.0, 0.75**0.5, 0.5), abs=1e-12)
    assert (sun.irradiance, sun.angle) == ((3.0, 3.0, 3.0), 0.53)
    assert sun_light((0.0, 90.0, 1.0, 5.0)).angle == 5.0
    light = point_light((1.0, 2.0, 3.0, 4.0))
    assert (light.position, light.intensity) == ((1.0, 2.0, 3.0), (4.0, 4.0, 4.0))
    with pytest.raises(ValueError, match="--sun: expected AZIMUTH"):
        sun_light((1.0, 2.0))


def test_ground():
    assert (parse_ground(None), parse_ground("lowest"), parse_ground("-0.5")) == (
        None,
        "lowest",
        -0.5,
    )
    with pytest.raises(ValueError, match="expected a height or the word lowest, got 'floor'"):
        parse_ground("floor")
