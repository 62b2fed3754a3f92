"""What the joint solve supposes before it knows the light: roughness and metal of a sphere."""

import math

import pytest
import torch
from sightings import lamps, sphere_of

from univoxel.config import JointConfig
from univoxel.solve import start
from univoxel.solve.start import TRIALS, supposed

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
    points, metals = [], []

    def newton_round(scene, problem, cfg, seconds, tell):
        points.append(torch.randperm(10).tolist())
        metals.append(bool(problem.metal.all()))
        assert seconds == 3.0
        assert cfg.newton_points == start.TRIED
        return [1.0]

    monkeypatch.setattr(start, "newton_round", newton_round)
    supposed(scene, problem, CFG, 3.0 * TRIALS, pytest.fail)
    assert len(points) == TRIALS
    assert all(p == points[0] for p in points)  # the trials differ in nothing but the supposition
    assert sum(metals) == TRIALS // 2 - 1  # the last of them with the metals that were found


def test_rounds_that_solve_nothing_change_nothing(monkeypatch):
    scene, problem = sphere_of((0.5, 0.3, 0.2), 0.0, 0.4)
    before = {k: v.clone() for k, v in scene.state_dict().items()}
    monkeypatch.setattr(start, "newton_round", lambda *_: [])
    assert supposed(scene, problem, CFG, math.inf, pytest.fail) is problem
    after = scene.state_dict()
    assert all(torch.equal(after[k], before[k]) for k in after)


@pytest.mark.parametrize(("left", "taken"), [(0.9, False), (0.7, True)])
def test_metal_everywhere_has_to_be_convincing(monkeypatch, left, taken):
    """It leaves less of the photographs in either case: under a wrong map so it may by chance."""
    scene, problem = sphere_of((0.5, 0.3, 0.2), 0.0, 0.4)

    def newton_round(scene, problem, *_):
        return [left if problem.metal.all() else 1.0]

    monkeypatch.setattr(start, "newton_round", newton_round)
    monkeypatch.setattr(start, "find_metal", lambda scene, problem, *_: problem.metal)
    assert bool(supposed(scene, problem, CFG, math.inf, pytest.fail).metal.all()) == taken
