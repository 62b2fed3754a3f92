"""What to photograph next, of a sphere that a sector of the photographs is kept back from."""

from dataclasses import replace

import pytest
import torch
from analytic import scene_of
from observed_points import RED, lamps, photographs_under
from torch.nn.functional import normalize

from univoxel.evaluation import confidence
from univoxel.evaluation import confidence as task
from univoxel.ops import VisibilityScene

NODES, VIEWS = 64, 40
EVERY = replace(confidence.ADVICE, least=0.0)


@pytest.fixture(scope="module")
def scene():
    return scene_of(RED, 0.4, NODES, lamps(NODES))


@pytest.fixture(scope="module")
def photos():
    return photographs_under(lamps(NODES), 0.4, views=VIEWS, size=48)


def taken_from(photos):
    return normalize(photos.cameras.camera_to_world[:, :, 3], dim=1)


def off(direction, azimuth):
    """Degrees [N] of azimuths from one."""
    return ((confidence.azimuths(direction) - azimuth + 180) % 360 - 180).abs()


def advice_of(scene, photos, cfg=EVERY):
    surveyed = confidence.survey(scene, photos, 1000)
    return confidence.advise(surveyed, photos.cameras, photos.names, scene.occluder(), cfg)


@pytest.mark.parametrize("azimuth", [0.0, 90.0, -150.0])
def test_it_sends_into_the_sector_that_was_not_photographed(scene, photos, azimuth):
    kept = photos.of((off(taken_from(photos), azimuth) > 45).nonzero()[:, 0])
    assert len(kept) < VIEWS - 6
    advice = advice_of(scene, kept, replace(EVERY, most=4))
    assert (off(advice.chosen, azimuth) <= 45).all()
    assert (advice.gains.diff() <= 1e-6).all()  # the best first
    apart = (advice.chosen @ advice.chosen.T).fill_diagonal_(-1).max()
    assert apart < 0.98  # and none twice: 11 degrees
    whole = advice_of(scene, photos)
    assert advice.gains[0] > 1.5 * whole.gains[0]
    # The gap is around the sector's middle, at about the height that photographs were taken from
    middle = advice.weighed[advice.gap]
    assert len(middle) > 10
    assert off(middle, azimuth).mean() < 25
    assert whole.gap.sum() <= 2  # the spiral leaves the poles
    (said,) = confidence.missing(advice, 60.0)
    assert said.startswith(f"no photograph from {confidence.place(advice, middle.mean(0))}"[:21])


def test_photographs_all_around_need_no_others(scene, photos):
    """Under a model that agrees with them: its own is red on the blue side too."""
    surveyed = confidence.survey(scene, photos, 1000)
    agreeing = replace(surveyed, disagreement=0 * surveyed.disagreement)
    advice = confidence.advise(agreeing, photos.cameras, photos.names, scene.occluder())
    assert len(advice.chosen) == len(advice.gains) == 0
    assert confidence.in_words(advice) == []


def test_what_stands_in_the_way_counts(scene, photos):
    """A wall at +X lets nobody look from there."""
    kept = photos.of((off(taken_from(photos), 0.0) > 60).nonzero()[:, 0])
    free = advice_of(scene, kept)
    assert (off(free.chosen[:3], 0.0) < 60).all()
    ball = scene.occluder()
    wall = torch.tensor([[0.8, y, z] for y, z in ((-9, -9), (9, -9), (9, 9), (-9, 9))])
    vertices = torch.cat([ball.vertices, wall])
    more = torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32) + len(ball.vertices)
    walled = VisibilityScene(vertices, torch.cat([ball.faces, more]))
    surveyed = confidence.survey(scene, kept, 1000)
    found = confidence.advise(surveyed, kept.cameras, kept.names, walled, EVERY)
    assert (found.chosen[:, 0] * 2.0 < 0.8).all()  # on this side of the wall
    behind = found.weighed[:, 0] > 0.5
    assert (found.worth[behind] == 0).all()


def test_nobody_is_sent_under_the_table(scene, photos, monkeypatch):
    high = confidence.elevations(taken_from(photos)) > 10
    kept = photos.of(high.nonzero()[:, 0])
    advice = advice_of(scene, kept)
    assert (confidence.elevations(advice.weighed) >= 0).all()
    assert advice.hidden > 0.03  # the underside: a cap below the horizon's cameras
    # Where a photograph was taken, others may be
    assert confidence.elevations(advice_of(scene, photos).weighed).min() < -50
    monkeypatch.setattr(task, "LOWEST", -90.0)
    under = advice_of(scene, kept)
    assert confidence.elevations(under.chosen).min() < -30
    assert under.hidden == 0


def test_in_words(scene, photos):
    advice = advice_of(scene, photos.of(torch.arange(5, 20)))
    degrees = [(90, 22), (80, 38), (100, 31), (-90, 5), (0, -12), (180, -3), (170, 4), (3, 80)]
    direction = []
    for azimuth, up in degrees:
        a, u = torch.tensor([azimuth + 30.0, up]).deg2rad()
        direction.append(torch.stack([u.cos() * a.cos(), u.cos() * a.sin(), u.sin()]))
    gains = torch.linspace(0.02, 0.01, len(degrees))
    advice = replace(advice, chosen=torch.stack(direction), gains=gains, front=30.0)
    assert confidence.in_words(advice) == [
        "Three photographs from the right, 20 to 40 degrees above the horizon",
        "Two photographs from the back, from 10 degrees below to 10 degrees above the horizon",
        "One photograph from the left, 0 to 10 degrees above the horizon",
        "One photograph from the front, 10 to 20 degrees below the horizon",
        "One photograph from above",
    ]
    assert advice.nearest[-1] in advice.names


def test_the_front_is_where_the_first_photograph_was_taken(scene, photos):
    for first in (20, 11):
        advice = advice_of(scene, photos.of(torch.tensor([first, 1, 2, 30, 39])))
        assert advice.front_name == photos.names[first]
        assert confidence.place(advice, taken_from(photos)[first]) == "the front"
    # One from above has no side
    advice = advice_of(scene, photos.of(torch.tensor([0, 25, 30])))
    assert confidence.elevations(taken_from(photos))[0] > 60
    assert advice.front_name in (photos.names[0], photos.names[25])
