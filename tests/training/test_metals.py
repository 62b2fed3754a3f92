"""Metal or not: decided on a sphere of known materials under a known map."""

from dataclasses import replace

import pytest
import torch
from observed_points import COUNT, NODES, photographed, sphere_of

from univoxel.color import linear_to_srgb_unclipped
from univoxel.config import JointConfig
from univoxel.training import metals, newton
from univoxel.training.metals import evidence, find_metal, fitted

CFG = JointConfig(newton_points=500, newton_views=8)


@pytest.mark.parametrize("roughness", [0.1, 0.35, 0.7])
def test_copper_is_told_from_paint_of_its_colour(roughness):
    scene, problem = sphere_of(
        (0.9, 0.6, 0.4), lambda n: (n[:, 0] > 0).float(), roughness, noise=0.02
    )
    found = find_metal(scene, problem, CFG, 1.0, False)
    assert found.dtype == torch.bool
    x = problem.observations.normal[:, 0]
    # 32 neighbours of 500 points lie within half a radian: the mean over them blurs the border
    assert found[x > 0.5].float().mean() > 0.97
    assert found[x < -0.5].float().mean() < 0.03


def test_black_plastic_is_no_black_metal():
    """A dielectric of no albedo reflects as a metal of F0 = 0.04 does: metals reflect more."""
    scene, problem = sphere_of((0.0, 0.0, 0.0), 0.0, 0.2)
    assert not find_metal(scene, problem, CFG, 1.0, False).any()
    assert evidence(scene, problem, CFG).median() > 1.0


def test_under_even_light_nothing_is_taken_for_metal():
    """Without highlights the two look nearly alike: no evidence is no metal."""
    scene, problem = sphere_of((0.6, 0.5, 0.4), 0.0, 0.9)
    with torch.no_grad():
        scene.sky.log_radiance.zero_()
    grey, rough = torch.full((COUNT, 3), 0.5), torch.full((COUNT,), 0.9)
    problem = photographed(problem, torch.ones(NODES, 3), grey, rough)
    noisy = problem.target + 0.02 * torch.randn_like(problem.target)
    assert not find_metal(scene, replace(problem, target=noisy), CFG, 1.0, False).any()


def test_one_observation_says_nothing():
    scene, problem = sphere_of((0.9, 0.6, 0.4), 1.0, 0.3, views=1)
    assert torch.equal(evidence(scene, problem, CFG), torch.zeros(COUNT))
    for likely in (False, True):  # nor where metal is likely
        assert not find_metal(scene, problem, CFG, 1.0, likely).any()


def test_one_point_speaks_for_all():
    """A scene may have no other whose observations suffice."""
    scene, problem = sphere_of((0.9, 0.6, 0.4), 1.0, 0.3)
    found = evidence(scene, problem, replace(CFG, newton_points=1))
    assert len(found) == COUNT
    assert len(found.unique()) == 1


def test_fitted_finds_the_best_base_within_its_bounds():
    """Against a search over all bases of one channel."""
    torch.manual_seed(0)
    constant, slope = 0.1 * torch.rand(6, 5, 3), torch.rand(6, 5, 3)
    target = torch.rand(6, 5, 3).clamp(0.1, 0.9)
    cauchy = newton.CAUCHY
    cost = fitted(constant, slope, target, 0.0)
    grey = torch.linspace(0.005, 1, 200)
    for p in range(6):
        best = 0.0
        for c in range(3):
            shown = constant[p, :, c] + grey[:, None] * slope[p, :, c]
            r = (target[p, :, c] - linear_to_srgb_unclipped(shown)) / cauchy
            best += cauchy**2 * torch.log1p(r.square()).mean(1).min() / 3
        # Gauss-Newton on Cauchy costs may end in a neighbouring valley, never below the best
        assert cost[p] >= best - 1e-5
        assert cost[p] < 1.5 * best + 1e-5
    held = fitted(constant, slope, torch.zeros(6, 5, 3), metals.MIN_REFLECTANCE)
    assert (held > fitted(constant, slope, torch.zeros(6, 5, 3), 0.0)).all()


def test_metal_takes_stronger_evidence_while_the_map_is_wrong(monkeypatch):
    ratios = torch.tensor([-0.5, -0.3, -0.2, -0.1, 0.4])
    monkeypatch.setattr(metals, "evidence", lambda *_: ratios)
    scene, problem = sphere_of((0.9, 0.6, 0.4), 0.0, 0.5)
    at_first, half_way, in_the_end, where_likely = (
        find_metal(scene, problem, CFG, done, likely).tolist()
        for done, likely in ((0.0, False), (0.5, False), (1.0, False), (1.0, True))
    )
    assert at_first == [True, False, False, False, False]
    assert half_way == [True, True, False, False, False]
    assert in_the_end == [True, True, True, False, False]
    assert where_likely == [True, True, True, True, False]
