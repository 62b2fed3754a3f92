"""What the joint solve starts from before it knows the light: roughness and metal of a sphere."""

import math
from dataclasses import replace

import pytest
import torch
from observed_points import lamps, no_metal, sphere_of

from univoxel.config import JointConfig
from univoxel.lights.views import ViewLights
from univoxel.training import metals as initialise
from univoxel.training.metals import (
    ONLY_METAL,
    ONLY_METAL_ALBEDO,
    TRIAL_POINTS,
    TRIAL_ROUNDS,
    find_metal,
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


@pytest.mark.parametrize(
    ("true", "begin", "wanted"), [(0.25, 0.6, 0.25), (0.7, 0.3, 0.7), (0.45, 0.45, 0.45)]
)
def test_the_roughness_that_explains_the_photographs_is_chosen(true, begin, wanted):
    """From a wrong one the whole moves to a better; the right one stays, to the bit."""
    scene, problem = sphere_of((0.5, 0.3, 0.2), 0.0, true)
    with torch.no_grad():
        scene.sky.log_radiance.zero_()
    features = scene.field.features_at(problem.observations.position)
    scene.material.shift_roughness(features, begin)
    before = scene.material(features)[1]
    initialised(scene, problem)
    found = scene.material(features)[1]
    torch.testing.assert_close(found.median(), torch.tensor(wanted), atol=1e-3, rtol=0)
    assert torch.equal(found, before) == (begin == wanted)


def test_trials_are_as_many_as_time_is_kept_for(monkeypatch):
    scene, problem = sphere_of((0.5, 0.3, 0.2), 0.0, 0.4)
    points, metals, spent = [], [], []

    def newton_round_(scene, problem, decisions, cfg, seconds):
        points.append(torch.randperm(10).tolist())
        metals.append(bool(decisions.metal.all()))
        spent.append(seconds)
        assert cfg.newton_points == TRIAL_POINTS
        return NewtonRound([2.0 if metals[-1] else 1.0])

    monkeypatch.setattr(initialise, "newton_round_", newton_round_)
    rounds = TRIAL_ROUNDS
    initialised(scene, problem, 3.0 * rounds)
    assert spent == [3.0] * rounds
    assert all(p == points[0] for p in points)  # the trials differ in nothing but the hypothesis
    assert metals == [True] * 3 + [False] * 5  # with what is found under the map of either at last


def test_rounds_that_solve_nothing_change_nothing(monkeypatch):
    scene, problem = sphere_of((0.5, 0.3, 0.2), 0.0, 0.4)
    before = {k: v.clone() for k, v in scene.state_dict().items()}
    monkeypatch.setattr(initialise, "newton_round_", lambda *_: NewtonRound())
    decisions = no_metal(problem)
    assert initialised(scene, problem, before=decisions) is decisions
    after = scene.state_dict()
    assert all(torch.equal(after[k], before[k]) for k in after)


@pytest.mark.parametrize(
    ("left", "share", "taken"),
    [(0.9, 0.3, False), (0.7, 0.3, True), (0.98, 0.8, False), (0.9, 0.8, True)],
)
def test_metals_that_are_found_from_metal_everywhere_have_to_be_better(
    monkeypatch, left, share, taken
):
    """By what they leave of the photographs: under a wrong map that is less by chance. Less so
    where most of the surface is metal then."""
    (scene, problem), supposed = sphere_of((0.5, 0.3, 0.2), 0.0, 0.4), []

    def newton_round_(scene, problem, decisions, *_):
        metal = decisions.metal
        supposed.append(metal)
        return NewtonRound([2.0 if metal.all() else left if metal.any() else 1.0])

    def find_metal(scene, problem, cfg, done):
        """A share is, of what is taken for metal everywhere; surely so, from a map for metals."""
        everywhere = done * torch.ones(len(supposed[0]), dtype=torch.bool)
        return everywhere.bool() & (torch.linspace(0, 1, len(everywhere)) < share)

    monkeypatch.setattr(initialise, "newton_round_", newton_round_)
    monkeypatch.setattr(initialise, "find_metal", find_metal)
    found = initialised(scene, problem)
    assert bool(found.metal.any()) == taken
    assert not found.only_metal


@pytest.mark.parametrize(
    ("known", "smooth", "rough", "found", "varying", "alike", "taken"),
    [
        (None, 1.1, 9.0, 9.0, False, 0.9, True),
        (None, 1.1, 9.0, 9.0, False, 0.3, False),  # grain leaves as much to either
        (None, 1.2, 0.9, 9.0, False, 0.9, False),  # as wide as diffuse light: it explains paint
        (None, 1.1, 9.0, 0.9, False, 0.9, False),  # what is found under the map of paint is better
        (None, 1.1, 9.0, 9.0, True, 0.9, False),  # photographs that mirror a map each
        (False, 0.9, 0.9, 9.0, False, 0.9, False),
        (True, 9.0, 9.0, 9.0, False, 0.3, True),
    ],
)
def test_where_metal_alone_explains_as_much_there_is_nothing_else(
    monkeypatch, known, smooth, rough, found, varying, alike, taken
):
    """Of fewer ways to explain the photographs, unless it is rough; and if most points look like
    metal then, however dark."""
    scene, problem = sphere_of((0.12, 0.08, 0.05), 1.0, 0.3)
    features = scene.field.features_at(problem.observations.position)
    searched, of_metal = [], []

    def newton_round_(scene, problem, decisions, *_):
        with torch.no_grad():
            problem.sky.log_radiance[0, 0] = float(decisions.metal.all())  # tells the maps apart
        if decisions.metal.all():
            return NewtonRound([rough if scene.material(features)[1].median() > 0.5 else smooth])
        return NewtonRound([found if searched else 1.0])

    def find_metal(scene, problem, cfg, done):
        if cfg.metal.min_reflectance == 0:
            of_metal.append((float(problem.sky.log_radiance.detach()[0, 0]), done))
            return torch.linspace(0, 1, len(problem.observations.position)) < alike
        searched.append(done)
        return no_metal(problem).metal

    monkeypatch.setattr(initialise, "newton_round_", newton_round_)
    monkeypatch.setattr(initialise, "find_metal", find_metal)
    if varying:
        scene.views = ViewLights(("a", "b", "c", "d"), 2, scene.sky.direction)
    cfg = replace(CFG, only_metal=known)
    decisions, _ = initialise_(scene, problem, no_metal(problem), cfg, math.inf)
    assert decisions.only_metal == taken
    assert bool(decisions.metal.all()) == taken
    # What would be found from metal everywhere is of no use where there is nothing else
    assert len(searched) == (0 if known else 1 if taken else 2)
    # Points are looked at under the map for metal, with the last threshold
    asked = known is None and not varying and smooth < ONLY_METAL * min(found, 1.0)
    assert of_metal == ([(1.0, 1.0)] if asked else [])


def test_grain_makes_no_metal_of_paint(monkeypatch):
    """Either leaves as much of noisy photographs; dark metal, without noise, is known as metal."""
    for noise, material, metal in ((0.1, ((0.5, 0.3, 0.2), 0.0, 0.4), False), (0.0, DARK, True)):
        torch.manual_seed(0)
        scene, problem = sphere_of(*material)
        with torch.no_grad():
            scene.sky.log_radiance.zero_()
        grain = noise * torch.randn(problem.target.shape)
        problem = replace(problem, target=(problem.target + grain).clamp(0, 1))
        asked = []

        def recorded(scene, problem, cfg, done, asked=asked):
            asked.append(cfg.metal.min_reflectance == 0)
            return find_metal(scene, problem, cfg, done)

        monkeypatch.setattr(initialise, "find_metal", recorded)
        assert initialised(scene, problem).only_metal == metal
        assert any(asked)  # the residuals alone would call either metal


def test_of_metal_alone_nothing_is_tried_but_roughness(monkeypatch):
    scene, problem = sphere_of((0.12, 0.08, 0.05), 1.0, 0.3)
    tried = []

    def newton_round_(scene, problem, decisions, *_):
        tried.append(bool(decisions.metal.all()))
        return NewtonRound([1.0])

    monkeypatch.setattr(initialise, "newton_round_", newton_round_)
    known = replace(CFG, only_metal=True)
    decisions, _ = initialise_(scene, problem, no_metal(problem), known, math.inf)
    assert decisions.metal.all()
    assert tried == [True] * 3


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
