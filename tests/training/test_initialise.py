"""What the joint solve starts from before it knows the light: whether a sphere is metal."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from observed_points import lamps, no_metal, sphere_of

from univoxel.config import JointConfig
from univoxel.lights.views import ViewLights
from univoxel.render.observations import first_labels
from univoxel.training import metals as initialise
from univoxel.training.metals import (
    ONLY_METAL_ALBEDO,
    TRIAL_POINTS,
    TRIAL_ROUNDS,
    initialise_,
    neutralise_,
)
from univoxel.training.newton import NewtonRound

CFG = JointConfig(newton_points=500, newton_views=8)
DARK = (0.12, 0.08, 0.05), 1.0, 0.3  # base colour, metallic and roughness of bronze with a patina


def initialised(scene, problem, seconds=math.inf, before=None):
    """The decisions, where no trial meets trouble."""
    before = before or no_metal(problem)
    decisions, troubles = initialise_(scene, problem, before, CFG, seconds)
    assert not troubles
    return decisions


def some_metal(problem, share):
    """Labels of which the first share is metal."""
    count = len(problem.observations.position)
    metal = torch.arange(count) < share * count
    return replace(no_metal(problem), metal=metal, likely=share > 0.15)


@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_the_better_hypothesis_is_found_without_a_map(metallic):
    """All of metal, or none: Newton under the wrong one leaves more of the photographs."""
    scene, problem = sphere_of((0.9, 0.6, 0.4), metallic, 0.3)
    with torch.no_grad():
        scene.sky.log_radiance.zero_()
    found = initialised(scene, problem)
    # Two short rounds from no map at all: where no lamp shines there is little evidence as yet
    assert (found.metal.float().mean() - metallic).abs() < 0.1
    error = (scene.sky.log_radiance - lamps(128).log()).detach()
    # Albedo and light share a scale; lamps are ten times as bright as the rest
    assert (error - error.mean()).abs().mean() < 0.5


def test_without_observations_nothing_is_decided():
    scene, problem = sphere_of((0.9, 0.6, 0.4), 1.0, 0.3, views=1)
    before = scene.sky.log_radiance.detach().clone()
    decisions = no_metal(problem)
    assert initialised(scene, problem, before=decisions) is decisions
    assert torch.equal(scene.sky.log_radiance, before)


def test_trials_are_as_many_as_time_is_kept_for(monkeypatch):
    scene, problem = sphere_of((0.5, 0.3, 0.2), 0.0, 0.4)
    points, metals, spent = [], [], []

    def newton_round_(scene, problem, decisions, cfg, seconds, unseen):
        points.append(torch.randperm(10).tolist())
        metals.append(float(decisions.metal.float().mean()))
        spent.append(seconds)
        assert cfg.newton_points == TRIAL_POINTS
        return NewtonRound([1.0], 2.0 if metals[-1] == 1 else 1.0)

    monkeypatch.setattr(initialise, "newton_round_", newton_round_)
    rounds = TRIAL_ROUNDS
    initialised(scene, problem, 3.0 * rounds, some_metal(problem, 0.2))
    assert spent == [3.0] * rounds
    assert all(p == points[0] for p in points)  # the trials differ in nothing but the hypothesis
    # As before, and everywhere, each with what is found under its map after it
    assert metals[0] == pytest.approx(0.2, abs=0.01)
    assert metals[2] == 1
    assert metals[1] < 0.1
    metals.clear()
    initialised(scene, problem, 0.0, some_metal(problem, 0.2))
    assert metals == [pytest.approx(0.2, abs=0.01)]  # time is over: the first one stands


def test_half_of_the_observations_are_fitted_and_the_others_judge(monkeypatch):
    """Every point has its observations in two halves that share none."""
    scene, problem = sphere_of((0.5, 0.3, 0.2), 0.0, 0.4)
    halves = []

    def newton_round_(scene, problem, decisions, cfg, seconds, unseen):
        halves.append((problem.observations, unseen.observations))
        return NewtonRound([1.0], 1.0)

    monkeypatch.setattr(initialise, "newton_round_", newton_round_)
    initialised(scene, problem)
    whole = problem.observations
    for fitted, judged in halves:
        counts = fitted.offsets.diff() + judged.offsets.diff()
        assert torch.equal(counts, whole.offsets.diff())
        assert (fitted.offsets.diff() - judged.offsets.diff()).abs().max() <= 2
        point = counts.nonzero()[0, 0]
        views = [o.view[o.offsets[point] : o.offsets[point + 1]].tolist() for o in (fitted, judged)]
        assert (
            sorted(views[0] + views[1])
            == whole.view[slice(*whole.offsets[point : point + 2])].tolist()
        )
        assert len(fitted.view) == len(fitted.color) == len(fitted.wo)


@pytest.mark.parametrize(("share", "likely"), [(0.0, False), (0.1, False), (0.2, True)])
def test_metal_is_likely_if_the_stages_before_saw_some(share, likely):
    """That is what the joint stage takes over from them, with their labels."""
    _, problem = sphere_of((0.5, 0.3, 0.2), 0.0, 0.4)
    metallic = 0.5 * some_metal(problem, share).metal.float()
    before = SimpleNamespace(
        field=SimpleNamespace(features_at=lambda _: None), material=lambda _: (0, 0, metallic)
    )
    labels = first_labels(before, problem, CFG)
    assert torch.equal(labels.metal, metallic > 0)
    assert labels.likely == likely


def test_rounds_that_solve_nothing_change_nothing(monkeypatch):
    scene, problem = sphere_of((0.5, 0.3, 0.2), 0.0, 0.4)
    before = {k: v.clone() for k, v in scene.state_dict().items()}
    monkeypatch.setattr(initialise, "newton_round_", lambda *_: NewtonRound())
    decisions = no_metal(problem)
    assert initialised(scene, problem, before=decisions) is decisions
    after = scene.state_dict()
    assert all(torch.equal(after[k], before[k]) for k in after)


@pytest.mark.parametrize(
    ("before", "everywhere", "left", "taken"),
    [
        (0.2, 2.0, 0.95, False),
        (0.2, 2.0, 0.85, True),
        (0.0, 2.0, 0.85, False),  # nothing suggests metal: what is found so is not asked for
    ],
)
def test_metals_that_are_found_from_metal_everywhere_have_to_be_better(
    monkeypatch, before, everywhere, left, taken
):
    """By what they leave of the photographs: under a wrong map that is less by chance."""
    scene, problem = sphere_of((0.5, 0.3, 0.2), 0.0, 0.4)
    found = some_metal(problem, 0.7).metal

    def newton_round_(scene, problem, decisions, *_):
        metal = decisions.metal
        cost = everywhere if metal.all() else left if torch.equal(metal, found) else 1.0
        return NewtonRound([1.0], cost)

    def find_metal(scene, problem, cfg, done, likely):
        """Surely, from a map for metals."""
        return found if done else torch.zeros_like(found)

    monkeypatch.setattr(initialise, "newton_round_", newton_round_)
    monkeypatch.setattr(initialise, "find_metal", find_metal)
    decisions = initialised(scene, problem, before=some_metal(problem, before))
    assert torch.equal(decisions.metal, found) == taken
    assert not decisions.only_metal


@pytest.mark.parametrize(
    ("known", "before", "everywhere", "varying", "taken"),
    [
        (None, 0.3, 1.05, False, True),
        (None, 0.3, 1.12, False, False),
        (None, 0.0, 0.85, False, False),  # a coloured sheen on wood
        (None, 0.0, 0.3, False, True),  # dark bronze, which the stages before take for paint
        (None, 0.3, 0.5, True, False),  # photographs that mirror a map each
        (False, 0.3, 0.5, False, False),
        (True, 0.0, 9.0, False, True),
    ],
)
def test_where_metal_alone_explains_as_much_there_is_nothing_else(
    monkeypatch, known, before, everywhere, varying, taken
):
    """The less the stages before saw of metal, the more it has to explain."""
    scene, problem = sphere_of((0.12, 0.08, 0.05), 1.0, 0.3)
    tried = []

    def newton_round_(scene, problem, decisions, *_):
        tried.append(bool(decisions.metal.all()))
        return NewtonRound([1.0], everywhere if tried[-1] else 1.0)

    monkeypatch.setattr(initialise, "newton_round_", newton_round_)
    monkeypatch.setattr(initialise, "find_metal", lambda *_: no_metal(problem).metal)
    if varying:
        scene.views = ViewLights(("a", "b", "c", "d"), 2, scene.sky.direction)
    cfg = replace(CFG, only_metal=known)
    decisions, _ = initialise_(scene, problem, some_metal(problem, before), cfg, math.inf)
    assert decisions.only_metal == taken
    assert bool(decisions.metal.all()) == taken
    assert not known or tried == [True]  # of metal alone nothing else is tried


def test_grain_makes_no_metal_of_paint():
    """Either leaves as much of noisy photographs; dark metal, without noise, is known as metal."""
    for noise, material, metal in ((0.1, ((0.5, 0.3, 0.2), 0.0, 0.4), False), (0.0, DARK, True)):
        torch.manual_seed(0)
        scene, problem = sphere_of(*material)
        with torch.no_grad():
            scene.sky.log_radiance.zero_()
        grain = noise * torch.randn(problem.target.shape)
        problem = replace(problem, target=(problem.target + grain).clamp(0, 1))
        assert initialised(scene, problem).only_metal == metal


def test_light_on_metal_alone_is_taken_for_neutral():
    """What photographs show, the product of map and albedo, stays."""
    scene, problem = sphere_of((0.12, 0.08, 0.05), 1.0, 0.3)
    features = scene.field.features_at(problem.observations.position)
    with torch.no_grad():
        scene.sky.log_radiance += torch.tensor([0.5, 0.0, -0.5])
    shown = scene.sky.radiance * scene.material(features)[0].median(0).values
    neutralise_(scene, problem)
    albedo = scene.material(features)[0].median(0).values
    torch.testing.assert_close(scene.sky.radiance * albedo, shown)
    tint = scene.sky.radiance.mean(0)
    torch.testing.assert_close(tint, tint.mean().expand(3))
    torch.testing.assert_close(albedo.max(), torch.tensor(ONLY_METAL_ALBEDO))
