"""Metal or not: under a known map, and from trials before the light is known."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from observed_points import COUNT, NODES, lamps, no_metal, photographed, sphere_of

from univoxel.color import linear_to_srgb_unclipped
from univoxel.config import JointConfig
from univoxel.lights.views import ViewLights
from univoxel.render.observations import first_labels
from univoxel.training import metals, newton
from univoxel.training.metals import (
    ONLY_METAL_ALBEDO,
    TRIAL_POINTS,
    TRIAL_ROUNDS,
    evidence,
    find_metal,
    fitted,
    initialise_,
    neutralise_,
)
from univoxel.training.newton import NewtonRound

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


@pytest.fixture
def judged(monkeypatch):
    """Stands in for Newton's rounds, whose cost follows from what is metal; what they got."""

    def stand_in(cost):
        given = []

        def newton_round_(scene, problem, decisions, cfg, seconds, unseen):
            given.append(
                SimpleNamespace(problem=problem, metal=decisions.metal, cfg=cfg, seconds=seconds,
                                unseen=unseen, drawn=torch.randperm(10).tolist())
            )  # fmt: skip
            return NewtonRound([1.0], cost(decisions.metal))

        monkeypatch.setattr(metals, "newton_round_", newton_round_)
        return given

    return stand_in


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


def test_trials_are_as_many_as_time_is_kept_for(judged):
    scene, problem = sphere_of((0.5, 0.3, 0.2), 0.0, 0.4)
    given = judged(lambda metal: 2.0 if metal.all() else 1.0)
    initialised(scene, problem, 3.0 * TRIAL_ROUNDS, some_metal(problem, 0.2))
    assert [one.seconds for one in given] == [3.0] * TRIAL_ROUNDS
    # The trials differ in nothing but the hypothesis
    assert all(one.drawn == given[0].drawn for one in given)
    assert all(one.cfg.newton_points == TRIAL_POINTS for one in given)
    # As before, and everywhere, each with what is found under its map after it
    shares = [float(one.metal.float().mean()) for one in given]
    assert shares[0] == pytest.approx(0.2, abs=0.01)
    assert shares[1] < 0.1
    assert shares[2] == 1
    given.clear()
    initialised(scene, problem, 0.0, some_metal(problem, 0.2))
    assert len(given) == 1  # time is over: the first one stands


def test_half_of_the_observations_are_fitted_and_the_others_judge(judged):
    """Every point has its observations in two halves that share none."""
    scene, problem = sphere_of((0.5, 0.3, 0.2), 0.0, 0.4)
    given = judged(lambda _: 1.0)
    initialised(scene, problem)
    whole = problem.observations
    for one in given:
        used, others = one.problem.observations, one.unseen.observations
        counts = used.offsets.diff() + others.offsets.diff()
        assert torch.equal(counts, whole.offsets.diff())
        assert (used.offsets.diff() - others.offsets.diff()).abs().max() <= 2
        point = counts.nonzero()[0, 0]
        views = [o.view[o.offsets[point] : o.offsets[point + 1]].tolist() for o in (used, others)]
        assert (
            sorted(views[0] + views[1])
            == whole.view[slice(*whole.offsets[point : point + 2])].tolist()
        )
        assert len(used.view) == len(used.color) == len(used.wo)


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
    monkeypatch.setattr(metals, "newton_round_", lambda *_: NewtonRound())
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
    monkeypatch, judged, before, everywhere, left, taken
):
    """By what they leave of the photographs: under a wrong map that is less by chance."""
    scene, problem = sphere_of((0.5, 0.3, 0.2), 0.0, 0.4)
    found = some_metal(problem, 0.7).metal
    judged(lambda m: everywhere if m.all() else left if torch.equal(m, found) else 1.0)

    def find_metal(scene, problem, cfg, done, likely):
        """Surely, from a map for metals."""
        return found if done else torch.zeros_like(found)

    monkeypatch.setattr(metals, "find_metal", find_metal)
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
    monkeypatch, judged, known, before, everywhere, varying, taken
):
    """The less the stages before saw of metal, the more it has to explain."""
    scene, problem = sphere_of((0.12, 0.08, 0.05), 1.0, 0.3)
    given = judged(lambda metal: everywhere if metal.all() else 1.0)
    monkeypatch.setattr(metals, "find_metal", lambda *_: no_metal(problem).metal)
    if varying:
        scene.views = ViewLights(("a", "b", "c", "d"), 2, scene.sky.direction)
    cfg = replace(CFG, only_metal=known)
    decisions, _ = initialise_(scene, problem, some_metal(problem, before), cfg, math.inf)
    assert decisions.only_metal == taken
    assert bool(decisions.metal.all()) == taken
    if known:  # nothing else is tried
        assert [bool(one.metal.all()) for one in given] == [True]


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
