"""Photographs that were exposed differently are told by the colours of the same points."""

import math
from dataclasses import replace

import pytest
import torch
from analytic import RADIUS, hull_of, photos_of
from torch.nn.functional import normalize

from univoxel.camera import image_rays
from univoxel.color import CLIPPED, linear_to_srgb
from univoxel.core.choices import Varying
from univoxel.preparation import prepare as task
from univoxel.preparation.prepare import (
    brightness_of,
    contradictions_left,
    log_gains,
    varying_and_gains,
)

VIEWS = 16


@pytest.fixture(scope="module")
def photos():
    """A ball, red on one side and blue on the other, no pixel of it clipped."""
    photos = photos_of(VIEWS, 32)
    return replace(photos, color=photos.color / 4)


@pytest.fixture(scope="module")
def hull(photos):
    return hull_of(photos)


def stops(most: float) -> torch.Tensor:
    """One for each view, from -most to most, of mean 0, in no order that neighbours share."""
    return torch.linspace(-most, most, VIEWS)[torch.arange(VIEWS) * 7 % VIEWS]


def exposed(photos, gains: torch.Tensor):
    return replace(photos, color=photos.color * 2 ** gains[:, None, None, None])


def rms(values: torch.Tensor) -> float:
    return float(values.square().mean().sqrt())


@pytest.mark.parametrize("most", [0.0, 0.5, 2.0])
def test_gains_are_found(photos, hull, most):
    found = log_gains(brightness_of(exposed(photos, stops(most)), *hull)) / math.log(2)
    assert float(found.sum()) == pytest.approx(0, abs=1e-4)
    # The hull of 16 views is larger than the ball: what is seen of a point is a little beside it
    assert rms(found - stops(most)) < 0.05


def test_what_is_no_surface_colour_counts_little(photos, hull):
    """Highlights, and clipped and black pixels, on a fifth of the photographs' pixels."""
    generator = torch.Generator().manual_seed(0)
    color = exposed(photos, stops(1.0)).color.clone()
    where = torch.rand(color.shape[:3], generator=generator)
    color[where < 0.05] = 1.0
    color[(where > 0.05) & (where < 0.1)] = 0.0
    color[(where > 0.1) & (where < 0.2)] *= 3.0
    found = log_gains(brightness_of(replace(photos, color=color), *hull)) / math.log(2)
    assert rms(found - stops(1.0)) < 0.1


def test_eight_bits_will_do(photos, hull):
    color = (255 * linear_to_srgb(exposed(photos, stops(1.0)).color)).round().to(torch.uint8)
    found = log_gains(brightness_of(replace(photos, color=color), *hull)) / math.log(2)
    assert rms(found - stops(1.0)) < 0.1


def test_clipped_pixels_tell_no_gain(photos, hull):
    """They would make the brightest photographs, seem darker: 0.06 stops in all."""
    color = (5 * exposed(photos, stops(1.0)).color).clamp(max=1)
    shown = photos.alpha > 0.99
    assert ((color == 1).any(-1) & shown).sum() > 0.1 * shown.sum()
    found = log_gains(brightness_of(replace(photos, color=color), *hull)) / math.log(2)
    assert rms(found - stops(1.0)) < 0.04  # as if nothing were clipped 0.02


def test_photographs_that_share_few_points():
    """Five around a ball: each point is seen in one or two."""
    photos = photos_of(5, 32)
    wanted = torch.tensor([1.0, -0.5, 0.8, -1.2, -0.1])
    color = photos.color / 4 * 2 ** wanted[:, None, None, None]
    found = log_gains(brightness_of(replace(photos, color=color), *hull_of(photos)))
    found = found / math.log(2)
    assert rms(found - wanted) < 0.03  # 0.008 here


def test_no_surface_and_a_black_photograph_say_nothing(photos, hull):
    sdf, grid = hull
    seen = brightness_of(photos, sdf.abs() + 1, grid)
    assert not log_gains(seen).any()
    assert contradictions_left(seen) == 1
    dark = photos.color.clone()
    dark[3] = 0
    found = log_gains(brightness_of(replace(photos, color=dark), *hull))
    assert found.isfinite().all()
    assert rms(found) < 0.05


@pytest.mark.parametrize(
    ("most", "varying", "look", "wanted", "told"),
    [
        (1.0, "none", True, "exposure", True),
        (1.0, "none", False, "none", False),
        (0.25, "none", True, "exposure", True),
        (0.0, "none", True, "none", False),
        (1.0, "exposure", True, "exposure", True),
        (0.0, "exposure", False, "exposure", True),
        (1.0, "light", True, "light", True),
    ],
)
def test_what_differs(
    photos, hull, caplog, most: float, varying: Varying, look: bool, wanted: Varying, told: bool
):
    caplog.set_level("INFO", "univoxel")
    found, gains = varying_and_gains(exposed(photos, stops(most)), *hull, varying, look)
    assert found == wanted
    assert (gains is not None) == told
    if gains is not None:
        assert rms(gains / math.log(2) - stops(most)) < 0.05
    # 0.61 and 0.15: of +-1 stop and +-0.25, evenly spread
    said = f"exposures differ by {0.61 * most:.2f} stops"
    assert (said in caplog.text) == (varying != wanted)


def test_what_a_ball_mirrors_is_no_exposure(photos, hull):
    """A room that is brighter above, with windows and dark corners."""
    color = torch.zeros_like(photos.color)
    for view in range(VIEWS):
        rays = image_rays(photos.cameras, view)
        along = -(rays.origin * rays.direction).sum(1)
        inside = (rays.origin + along[:, None] * rays.direction).square().sum(1) < RADIUS**2
        at = rays.origin + along[:, None] * rays.direction
        depth = (RADIUS**2 - at.square().sum(1)).clamp_min(0).sqrt()
        normal = normalize(at - depth[:, None] * rays.direction, dim=1)
        cosine = (normal * rays.direction).sum(1, keepdim=True)
        x, y, z = (rays.direction - 2 * cosine * normal).unbind(1)
        sky = 0.1 * (0.5 * z + (6 * x).sin() * (5 * y + 4 * z).cos()).exp()
        color[view] = (sky * inside).reshape(color.shape[1:3])[..., None]
    mirror = replace(photos, color=color)
    assert rms(log_gains(brightness_of(mirror, *hull))) > 0.25 * math.log(2)
    assert varying_and_gains(mirror, *hull, "none", look=True) == ("none", None)
    differ = exposed(mirror, stops(1.0))
    assert varying_and_gains(differ, *hull, "none", look=True)[0] == "exposure"


def test_nothing_is_looked_for_that_was_not_asked_for(photos, hull, monkeypatch):
    monkeypatch.setattr(task, "brightness_of", None)
    assert varying_and_gains(photos, *hull, "none", look=False) == ("none", None)


@pytest.mark.parametrize(("gain", "told"), [(1.0, False), (64.0, True)])
def test_much_that_is_overexposed_is_said(photos, caplog, gain, told):
    """And linear photographs are not clipped."""
    caplog.set_level("INFO", "univoxel")
    encoded = (255 * linear_to_srgb(gain * photos.color)).round().byte()
    eight_bits = replace(photos, color=encoded, alpha=(255 * photos.alpha).round().byte())
    task.say_clipped(eight_bits)
    assert ("of the object is overexposed" in caplog.text) == told
    seen = eight_bits.color[eight_bits.alpha > 127]
    expected = (seen > 255 * CLIPPED).any(1).float().mean()
    assert task.clipped_share(eight_bits) == pytest.approx(float(expected), abs=1e-6)
    assert (expected > 0.5) == told
    assert task.clipped_share(replace(photos, color=100 * photos.color)) == 0
