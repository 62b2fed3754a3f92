"""Lights and the ground as the command line writes them; the package's functions."""

import subprocess
import sys

import pytest

import univoxel
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
    with pytest.raises(ValueError, match="--ground: expected lowest or a height, got 'floor'"):
        parse_ground("floor")


def test_the_package_has_the_work_and_stays_cheap():
    code = "import sys, univoxel; dir(univoxel); assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
    from univoxel import api
    from univoxel.cli import evaluate, export, relight

    assert univoxel.train is api.train
    assert univoxel.evaluate is evaluate.evaluate
    assert univoxel.export is export.export
    assert univoxel.relight is relight.relight_images
    assert "relight" in dir(univoxel)
    with pytest.raises(AttributeError, match="no attribute 'relit'"):
        univoxel.relit  # noqa: B018
