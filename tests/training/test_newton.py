"""Newton's method for the map, on points of a sphere whose truth is known."""

import math
from dataclasses import replace
from unittest.mock import Mock

import pytest
import torch
from analytic import scene_of
from observed_points import lamps, no_metal, photographed, problem_on_a_sphere, random_problem

from univoxel import brdf
from univoxel.config import JointConfig
from univoxel.render.observations import MaterialLabels, halves, prefiltered_roughness
from univoxel.training import newton
from univoxel.training.newton import (
    MAX_ALBEDO_CHANGE,
    MAX_ROUGHNESS_CHANGE,
    NewtonPoints,
    NewtonRound,
    newton_round_,
)

CFG = JointConfig(newton_points=400, newton_views=8, newton_steps=6)
PAINT = (0.5, 0.4, 0.3)


def painted(map, views=12, believed=0.3):
    """A scene that knows the paint, and believes this of its roughness, which is 0.3; of another
    map than the one that it is photographed under."""
    nodes = len(map)
    scene = scene_of(PAINT, believed, nodes)
    problem = problem_on_a_sphere(400, views, nodes, scene)
    shown = prefiltered_roughness(torch.full((400,), 0.3), nodes)  # a node is a patch of sky
    return scene, photographed(problem, map, torch.tensor(PAINT).expand(400, 3), shown)


def uneven():
    torch.manual_seed(2)
    return (0.6 * torch.randn(64, 3)).exp() * 0.6


def check_solved(scene, problem, labels, true):
    """By two rounds; what is left is the smoothness, which this uneven map has none of."""
    costs = [c for _ in range(2) for c in newton_round_(scene, problem, labels, CFG).costs]
    assert len(costs) == 2 * CFG.newton_steps
    assert costs[-1] < 1e-3 * costs[0]
    error = scene.sky.log_radiance.detach() - true.log()
    assert error.abs().mean() < 0.25 * true.log().abs().mean()


def test_newton_recovers_a_known_map():
    scene, problem = painted(true := uneven())
    check_solved(scene, problem, no_metal(problem), true)


def test_newton_finds_the_map_under_a_roughness_that_is_wrong(monkeypatch):
    """Where roughness may change, the map is right; where it stays, the map takes the error on."""
    errors, rougher = [], []
    for free in (1e-6, newton.FOLLOWS):
        monkeypatch.setattr(newton, "FOLLOWS", free)
        scene, problem = painted(lamps(64), believed=0.45)
        for _ in range(2):
            found = newton_round_(scene, problem, no_metal(problem), CFG)
        errors.append((scene.sky.log_radiance.detach() - lamps(64).log()).abs().mean())
        rougher.append(found.to_roughness)
    assert abs(rougher[0]) < 1e-3
    assert rougher[1] < -0.02  # towards 0.3, as the points are
    assert errors[1] < 0.5 * errors[0]  # not all: roughness has a pull to where it was


def test_a_round_is_judged_by_observations_that_it_did_not_use():
    """It explains them if they show the same, and their error counts in full where they do not;
    clipped pixels are lower bounds, and of points that have no other observation nothing counts."""
    scene, problem = painted(lamps(64))
    fitted, unseen = halves(problem)
    start = scene.sky.log_radiance.detach().clone()

    def judged(other):
        with torch.no_grad():
            scene.sky.log_radiance.copy_(start)
        torch.manual_seed(0)
        return newton_round_(scene, fitted, no_metal(problem), CFG, unseen=other).unseen

    explained = judged(unseen)
    assert explained < 0.1 * newton.CAUCHY**2
    off = replace(unseen, target=(unseen.target - 0.5))
    assert judged(off) > newton.CAUCHY**2 * math.log1p((0.4 / newton.CAUCHY) ** 2)
    assert judged(replace(unseen, target=torch.full_like(unseen.target, 1.0))) > explained
    with torch.no_grad():
        bright = replace(unseen, target=torch.full_like(unseen.target, 0.99))
        scene.sky.log_radiance.fill_(5.0)
        points = newton.choose_points(scene, fitted, no_metal(problem), CFG)
        assert newton.unseen_cost(scene, points, bright) == 0
    ends = unseen.observations.offsets.clamp_min(unseen.observations.offsets[200])
    target = unseen.target.clone()
    target[ends[200]] -= 0.5  # which stands where the first 200 points would look
    few = replace(unseen.observations, offsets=ends)
    assert judged(replace(unseen, observations=few, target=target)) < 0.2 * newton.CAUCHY**2
    none = replace(unseen.observations, offsets=torch.zeros_like(unseen.observations.offsets))
    assert judged(replace(unseen, observations=none)) == math.inf


@pytest.mark.parametrize("views", [2, 3])
def test_newton_learns_from_few_photographs(views):
    scene, problem = painted(uneven(), views)
    costs = newton_round_(scene, problem, no_metal(problem), CFG).costs
    assert len(costs) == CFG.newton_steps
    assert costs[-1] < 0.1 * costs[0]


def test_newton_in_no_time_takes_few_points(monkeypatch):
    scene = scene_of((0.5, 0.4, 0.3), 0.4, 32)
    problem = problem_on_a_sphere(100, 12, 32, scene)
    equations = Mock(wraps=newton.equations.normal_equations)
    monkeypatch.setattr(newton.equations, "normal_equations", equations)
    monkeypatch.setattr(newton, "NEWTON_CHUNK", 20)
    cfg = replace(CFG, newton_steps=2)
    newton_round_(scene, problem, no_metal(problem), cfg, seconds=0.0)
    parts = 1 + cfg.newton_steps * newton.MIN_PARTS  # one to measure
    assert [len(call.args[0].diffuse) for call in equations.call_args_list] == [20] * parts
    equations.reset_mock()
    newton_round_(scene, problem, no_metal(problem), cfg, seconds=1e3)
    parts = 1 + cfg.newton_steps * 5
    assert [len(call.args[0].diffuse) for call in equations.call_args_list] == [20] * parts


@pytest.mark.parametrize(("views", "steps"), [(8, 0), (1, 6)])
def test_without_steps_or_rich_points_newton_leaves_the_map(views, steps):
    """Of one observation the albedo explains everything."""
    scene = scene_of((0.5, 0.5, 0.5), 0.4, 32)
    problem, cfg = problem_on_a_sphere(20, views, 32, scene), replace(CFG, newton_steps=steps)
    assert newton_round_(scene, problem, no_metal(problem), cfg, seconds=10.0) == NewtonRound()
    assert (scene.sky.log_radiance == 0).all()


def test_parts_are_of_one_material(monkeypatch):
    monkeypatch.setattr(newton, "NEWTON_CHUNK", 4)
    point, metal = torch.randperm(30)[:22], torch.arange(30) % 3 == 0
    order, parts = newton.in_parts(point, metal)
    assert sorted(order.tolist()) == sorted(point.tolist())
    assert torch.equal(torch.cat(parts), torch.arange(22))
    for part in parts:
        assert 1 <= len(part) <= 4
        assert len(metal[order[part]].unique()) == 1


def test_metals_show_the_map():
    """Half of a sphere in copper: light is found, whose colour is not that of the metal."""
    nodes, count = 64, 600
    base, roughness = torch.tensor([0.9, 0.6, 0.4]), 0.3
    scene = scene_of(tuple(base.tolist()), roughness, nodes)
    problem = problem_on_a_sphere(count, 12, nodes, scene)
    metal = problem.observations.normal[:, 0] > 0
    true = uneven()
    shown = prefiltered_roughness(torch.full((count,), roughness), nodes)
    diffuse, f0 = brdf.split(base.expand(count, 3), metal.float())
    problem = photographed(problem, true, diffuse, shown, f0)
    check_solved(scene, problem, MaterialLabels(metal), true)


def test_newton_starts_from_the_albedo_that_it_is_given():
    scene = scene_of((0.5, 0.5, 0.5), 0.4, 12)
    problem = random_problem(50, scene=scene)
    cfg = replace(CFG, newton_points=20, newton_views=2)
    albedo = torch.rand(50, 3)
    nothing, given = no_metal(problem), replace(no_metal(problem), albedo=albedo)
    points = newton.choose_points(scene, problem, given, cfg)
    torch.testing.assert_close(points.log_albedo, albedo[points.point].clamp_min(1e-3).log())
    torch.testing.assert_close(
        newton.choose_points(scene, problem, nothing, cfg).log_albedo,
        torch.full((20, 3), 0.5).log(),
    )


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_step_changes_a_point_by_no_more_than_so_much(sign):
    class Far:
        def back_substituted(self, _):
            return torch.full((5, 3), 9.0 * sign), torch.full((5,), 9.0 * sign)

    nothing, of_all = torch.zeros(5, dtype=torch.int64), [torch.arange(5)]
    numbers = torch.full((5, 3), -2.0), torch.full((5,), 0.5), torch.full((5,), 0.5)
    points = NewtonPoints(None, nothing.bool(), nothing, nothing[:, None], of_all, *numbers)
    points.step_([Far()], torch.zeros(3, 1))
    assert torch.equal(points.log_albedo, numbers[0] + sign * MAX_ALBEDO_CHANGE)
    assert torch.equal(points.roughness, numbers[1] + sign * MAX_ROUGHNESS_CHANGE)
