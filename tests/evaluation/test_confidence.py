"""What is said of a sphere whose cameras, light and material are known."""

import math
from dataclasses import replace

import pytest
import torch
from analytic import photos_of, scene_of
from observed_points import RED, lamps, photographs_under

from univoxel.evaluation import confidence
from univoxel.evaluation.confidence import (
    GOOD,
    LARGEST,
    UNSEEN,
    ExpectedErrors,
    numbers,
    spread_observations,
    survey,
    words,
)
from univoxel.render.observations import MIN_COSINE, Observations

NODES, ROUGHNESS = 64, 0.4


@pytest.fixture(scope="module")
def scene():
    return scene_of(RED, ROUGHNESS, NODES, lamps(NODES))


@pytest.fixture(scope="module")
def photos():
    return photographs_under(lamps(NODES), ROUGHNESS, views=16, size=48)


@pytest.fixture(scope="module")
def surveyed(scene, photos):
    return survey(scene, photos, 1000)


def test_views_and_visibility_of_a_convex_body(surveyed, photos):
    eye = photos.cameras.camera_to_world[:, :, 3]
    towards = torch.nn.functional.normalize(eye - surveyed.position[:, None], dim=2)
    cosine = (towards * surveyed.normal[:, None]).sum(2)
    # Pixels of the silhouette are left out: in between the views there may or may not see a point
    for least, sign in ((MIN_COSINE, 1), (0.5, -1)):
        seen = cosine > least
        straight = (seen * cosine.square()).sum(1)
        assert (sign * (seen.sum(1) - surveyed.views) >= 0).all()
        assert (sign * (straight - surveyed.straight) >= -0.05).all()  # normals are the grid's
    assert surveyed.visibility.min() > 0.97
    assert surveyed.spread.min() > 20
    assert not surveyed.black.any()


def test_errors_are_expected_where_the_photographs_differ(scene, surveyed):
    """The sphere is red on one side, as the scene has it everywhere, and blue on the other."""
    red, blue = surveyed.position[:, 0] > 0.1, surveyed.position[:, 0] < -0.1
    assert surveyed.disagreement[red].mean() < 0.02
    assert surveyed.disagreement[blue].mean() > 0.1
    albedo = surveyed.errors[:, 0]
    assert albedo[blue].mean() > 1.5 * albedo[red].mean()
    assert (surveyed.errors > 0).all()
    assert (surveyed.errors <= torch.tensor(LARGEST)).all()


def test_what_no_camera_sees_is_a_guess(scene, photos):
    ahead = photos.cameras.camera_to_world[:, 2, 3] > 1.0
    surveyed = survey(scene, photos.of(ahead.nonzero()[:, 0]), 1000)
    below = surveyed.normal[:, 2] < -0.6
    assert (surveyed.views[below] == 0).all()
    assert (surveyed.errors[below] == torch.tensor(UNSEEN)).all()
    assert (surveyed.errors[surveyed.views > 3] < torch.tensor(UNSEEN)).any()
    figures = numbers(surveyed)
    assert 0.1 < figures["unseen"] <= figures["few_views"] < 0.9
    said = words(figures, [])
    assert f"{figures['few_views']:.0%} of the surface is seen by fewer than 3 cameras" in said
    one = survey(scene, photos.of(torch.arange(1)), 100)
    assert (one.spread < 0.1).all()  # an arc cosine next to 1


def test_clipped_and_black_pixels_say_nothing(scene):
    photos = photos_of(6, 24)
    bright = survey(scene, replace(photos, color=100 * photos.color), 200)
    dark = survey(scene, replace(photos, color=1e-4 * photos.color), 200)
    for surveyed, share in ((bright, bright.clipped), (dark, dark.black)):
        seen = surveyed.views > 0
        assert (share[seen] == 1).all()
        assert (surveyed.straight == 0).all()
    assert "overexposed in most photographs" in words(numbers(bright), [])
    assert "black in most photographs" in words(numbers(dark), [])


def test_each_term_counts_as_the_table_says(surveyed, monkeypatch):
    """Twice the disagreement is 2^0.5 times the error where the weight is a half, and so on."""
    weights = {"disagreement": 0.5, "visibility": -1.0, "clipped": 2.0}
    table = {
        "albedo": (-3.0, weights),
        "roughness": (-2.0, {"roughness": 1.0}),
        "normal": (1.0, {"spread": 1.0}),
    }
    monkeypatch.setattr(confidence, "EXPECTED", table)
    one = torch.ones(1)
    point = replace(
        surveyed,
        **{name: one for name in ("views", "visibility", "straight", "bumpiness", "variation")},
        **{name: 0 * one for name in ("clipped", "gloss", "recovered_roughness")},
        disagreement_nearby=0.01 * one,
        spread=8 * one,
    )
    told = point.errors[0]
    expected = torch.tensor([math.exp(-3) * 0.01**0.5, math.exp(-2), 8 * math.e])
    torch.testing.assert_close(told, expected)
    for name, value, times in (
        ("disagreement_nearby", 0.04, 2.0), ("visibility", 0.5, 2.0), ("clipped", 0.5, math.e),
    ):  # fmt: skip
        changed = replace(point, **{name: value * one}).errors[0, 0]
        assert changed / told[0] == pytest.approx(times, rel=1e-4)
    assert replace(point, spread=80 * one).errors[0, 2] == LARGEST[2]


def test_surroundings_do_not_depend_on_how_many_points_are_surveyed(scene, photos, surveyed):
    few = survey(scene, photos, 100)
    assert float(few.bumpiness.mean() / surveyed.bumpiness.mean()) == pytest.approx(1, abs=0.15)
    assert surveyed.variation.max() < 1e-3  # it has one colour everywhere


def test_the_report_names_its_thresholds(surveyed, monkeypatch):
    for name, value in {"FEW_VIEWS": 17, "MIN_SHARE": 0.0, "MAX_DISAGREEMENT": 0.5}.items():
        monkeypatch.setattr(confidence, name, value)
    figures = numbers(surveyed)
    assert figures["few_views"] == 1.0  # there are 16 photographs
    said = words(figures, [])
    assert "100% of the surface is seen by fewer than 17 cameras" in said
    assert "0% of the surface differs from its photographs by more than 0.5 in sRGB" in said
    monkeypatch.setattr(confidence, "MIN_SHARE", 1.0)
    assert "0% of the surface differs" not in words(figures, [])


def test_some_observations_are_spread_over_all():
    counts = torch.tensor([0, 3, 17])
    offsets = torch.cat([torch.zeros(1, dtype=torch.int64), counts.cumsum(0)])
    nothing = torch.zeros(20, 3)
    seen = Observations(nothing[:3], nothing[:3], offsets, nothing, nothing, offsets, nothing[:1])
    point, observation = spread_observations(seen, 4)
    assert point.tolist() == [1, 1, 1, 2, 2, 2, 2]
    assert observation.tolist() == [0, 1, 2, 3, 7, 11, 15]


def test_expected_errors_are_those_of_the_nearest_on_the_same_side(surveyed):
    found = ExpectedErrors(surveyed)
    exact = found.at(surveyed.position, surveyed.normal)
    torch.testing.assert_close(exact, surveyed.errors, rtol=1e-3, atol=1e-4)
    # A sheet of no thickness: the camera sees what is above, and nothing below
    x = torch.rand(200, 2)
    top = torch.cat([x, torch.zeros(200, 1)], 1)
    up = torch.tensor([0.0, 0.0, 1.0]).expand(200, 3)
    values = (
        *(("views", 9), ("straight", 9.0), ("visibility", 1.0), ("disagreement_nearby", 0.0)),
        ("disagreement", 0.0),
        *(("gloss", 1e3), ("bumpiness", 0.0), ("variation", 0.0), ("spread", 2), ("clipped", 0.0)),
        ("recovered_roughness", 0.0),
    )
    same = {name: torch.full((400,), float(value)) for name, value in values}
    same["views"][200:] = 0
    position, normal = torch.cat([top, top]), torch.cat([up, -up])
    sheet = replace(surveyed, position=position, normal=normal, voxel_size=0.5, **same)
    found, guess = ExpectedErrors(sheet), torch.tensor(UNSEEN)
    assert (found.at(top, up) < 0.5 * guess).all()
    torch.testing.assert_close(found.at(top, -up), guess.expand(200, 3))


def test_words_leave_out_what_is_not_the_case(surveyed):
    agreeing, views = 0 * surveyed.disagreement, 9 + surveyed.views
    still = replace(surveyed, disagreement=agreeing, views=views)
    figures = numbers(still)
    said = words(figures, [])
    assert said.startswith("Mean expected error of the surface: 0.")
    for name in GOOD:
        assert f"On {figures[f'{name}_good']:.0%} of the surface, the {name} is good" in said
    assert "cameras" not in said
    assert "differs" not in said
    assert "A bright albedo and a bright light look the same" in said
    assert "trouble" not in said
    assert "recovered: 2. The last one: stage 1: b." in words(figures, ["a", "stage 1: b"])
