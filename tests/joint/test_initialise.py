"""What the joint solve supposes before it knows the light: roughness and metal of a sphere."""

import math

import pytest
import torch
from observed_points import lamps, sphere_of

from univoxel.joint import initialise
from univoxel.joint.config import JointConfig
from univoxel.joint.initialise import TRIALS, supposed

CFG = JointConfig(newton_points=500, newton_views=8)


@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_the_better_supposition_is_found_without_a_map(metallic):
    """All of metal, or none: Newton under the wrong one leaves more of the photographs."""
    scene, problem = sphere_of((0.9, 0.6, 0.4), metallic, 0.3)
    with torch.no_grad():
        scene.sky.log_radiance.zero_()
    found = supposed(scene, problem, CFG, math.inf, pytest.fail)
    # Two short rounds from no map at all: where no lamp shines there is little evidence as yet
    assert (found.metal.float().mean() - metallic).abs() < 0.1
    error = (scene.sky.log_radiance - lamps(128).log()).detach()
    # Albedo and light share a scale; lamps are ten times as bright as the rest
    assert (error - error.mean()).abs().mean() < 0.5


def test_without_sightings_nothing_is_supposed():
    scene, problem = sphere_of((0.9, 0.6, 0.4), 1.0, 0.3, views=1)
    before = scene.sky.log_radiance.detach().clone()
    assert supposed(scene, problem, CFG, math.inf, pytest.fail) is problem
    assert torch.equal(scene.sky.log_radiance, before)


@pytest.mark.parametrize(
    ("true", "begin", "wanted"),
    [(0.25, 0.6, 0.25), (0.7, 0.3, 0.7), (0.45, 0.45, 0.45)],
)
def test_the_roughness_that_explains_the_photographs_is_supposed(true, begin, wanted):
    """From a wrong one the whole moves to a better; the right one stays, to the bit."""
    scene, problem = sphere_of((0.5, 0.3, 0.2), 0.0, true)
    with torch.no_grad():
        scene.sky.log_radiance.zero_()
    features = scene.field.features_at(problem.seen.position)
    scene.material.shift_roughness(features, begin)
    before = scene.material(features)[1]
    supposed(scene, problem, CFG, math.inf, pytest.fail)
    found = scene.material(features)[1]
    torch.testing.assert_close(found.median(), torch.tensor(wanted), atol=1e-3, rtol=0)
    assert torch.equal(found, before) == (begin == wanted)


def test_trials_are_as_many_as_time_is_kept_for(monkeypatch):
    scene, problem = sphere_of((0.5, 0.3, 0.2), 0.0, 0.4)
    points, metals, spent = [], [], []

    def newton_round(scene, problem, cfg, seconds, tell):
        points.append(torch.randperm(10).tolist())
        metals.append(bool(problem.metal.all()))
        spent.append(seconds)
        assert cfg.newton_points == initialise.TRIED * seconds / 3.0
        return [1.0]

    monkeypatch.setattr(initialise, "newton_round", newton_round)
    supposed(scene, problem, CFG, 3.0 * TRIALS, pytest.fail)
    assert sum(spent) == 3.0 * TRIALS
    assert all(p == points[0] for p in points)  # the trials differ in nothing but the supposition
    assert metals == [False] * 4 + [True] * 3 + [False]  # the last with the metals that were found


def test_rounds_that_solve_nothing_change_nothing(monkeypatch):
    scene, problem = sphere_of((0.5, 0.3, 0.2), 0.0, 0.4)
    before = {k: v.clone() for k, v in scene.state_dict().items()}
    monkeypatch.setattr(initialise, "newton_round", lambda *_: [])
    assert supposed(scene, problem, CFG, math.inf, pytest.fail) is problem
    after = scene.state_dict()
    assert all(torch.equal(after[k], before[k]) for k in after)


@pytest.mark.parametrize(
    ("lowest", "left", "share", "taken"),
    [
        (0.5, 0.9, 0.3, False),
        (0.9, 0.7, 0.3, True),
        (0.98, 0.98, 0.8, False),
        (0.98, 0.9, 0.8, True),
        (0.9, 1.2, 0.8, True),
    ],
)
def test_metal_everywhere_has_to_be_convincing(monkeypatch, lowest, left, share, taken):
    """What it leaves of the photographs, everywhere or only where metal was found: under a wrong
    map that is less by chance. Less so where most of the surface is metal then."""
    scene, problem = sphere_of((0.5, 0.3, 0.2), 0.0, 0.4)

    def newton_round(scene, problem, *_):
        return [lowest if problem.metal.all() else left if problem.metal.any() else 1.0]

    def find_metal(scene, problem, cfg, done):
        """A share is, of what is taken for metal everywhere; surely so, from a map for metals."""
        assert done == float(problem.metal.all())
        return problem.metal & (torch.linspace(0, 1, len(problem.metal)) < share)

    monkeypatch.setattr(initialise, "newton_round", newton_round)
    monkeypatch.setattr(initialise, "find_metal", find_metal)
    assert bool(supposed(scene, problem, CFG, math.inf, pytest.fail).metal.any()) == taken
