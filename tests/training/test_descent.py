"""Trainings whose numbers fail on purpose, and those that gain nothing any more."""

import dataclasses
import json

import pytest
import torch
from analytic import photos_of, sphere_scene
from observed_points import Steps, no_metal, problem_on_a_sphere
from plain import plain_stage, plain_training, small_scene

from univoxel.cli import trainer as task
from univoxel.cli.trainer import train
from univoxel.config import JointConfig
from univoxel.lights import SGConfig
from univoxel.optim import RowAdam
from univoxel.scene import SceneConfig, load_checkpoint, load_scene
from univoxel.training import descent, equations, joint_solve, loop, newton
from univoxel.training import progress as progress_module
from univoxel.training.descent import CHECK, LIMIT, PROOF, WINDOW, Guard, Plateau


def small(data, out):
    stage = plain_stage(voxels=0.008, iterations=24, share=0.5, rays=256)
    stages = (stage, dataclasses.replace(stage, physical_from=0.0))
    return plain_training(data, out, stages, minutes=60.0, scene=small_scene())


def events(out):
    lines = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    return [line["trouble"] for line in lines if "trouble" in line]


def finite(module):
    return all(bool(value.isfinite().all()) for value in module.state_dict().values())


def bad_loss(terms, scene):
    return terms | {"bad": terms["radiance"] * float("nan")}


def bad_gradient(terms, scene):
    """A loss that is a number, with a gradient that is none."""
    return terms | {"bad": (0 * scene.material.net[-1].bias.sum()).abs().sqrt()}


def huge_gradient(terms, scene):
    """Finite, but its square is not."""
    return terms | {"bad": 1e20 * scene.material.net[-1].bias.sum()}


def failing(monkeypatch, module, name, how, when):
    """`module.name`, broken in the steps whose number `when` accepts; the calls so far."""
    original, calls = getattr(module, name), []

    def broken(scene, *rest):
        terms = original(scene, *rest)
        calls.append(None)
        return how(terms, scene) if when(len(calls) - 1) else terms

    monkeypatch.setattr(module, name, broken)
    return calls


@pytest.mark.parametrize("how", [bad_loss, bad_gradient, huge_gradient])
def test_one_bad_step_is_dropped(data, tmp_path, monkeypatch, caplog, how):
    caplog.set_level("INFO", "univoxel")
    calls = failing(monkeypatch, loop, "losses_of", how, lambda i: i == 7)
    out = task.train(small(data, tmp_path / "run"))
    assert len(calls) == 48
    assert finite(load_scene(out))
    (told,) = events(out)
    what = "the loss is nan" if how is bad_loss else "a gradient is not finite"
    assert told.startswith(f"stage 1, step 7: {what}; dropped this step; the step size was")
    assert told in caplog.messages
    assert "training failed once and recovered" in caplog.text


def test_a_failure_that_stays_ends_its_stage(data, tmp_path, monkeypatch):
    calls = failing(monkeypatch, loop, "losses_of", bad_gradient, lambda i: 7 <= i < 20)
    out = task.train(small(data, tmp_path / "run"))
    told = events(out)
    assert len(told) == 2 * (LIMIT + 1)
    assert "dropped this step" in told[0]
    assert all("returned to the last good state" in t for t in told[1:LIMIT])
    assert told[LIMIT].startswith(f"stage 1, step {7 + LIMIT}:")
    assert told[LIMIT].endswith("the stage ends with the last good state")
    assert told[-1].startswith("stage 2,")
    assert len(calls) == 7 + 2 * (LIMIT + 1)
    assert finite(load_scene(out))


def test_nothing_but_failure_leaves_the_state_it_began_with(data, tmp_path, monkeypatch):
    original, states = task.run_stage, []

    def watched(scene, *rest):
        states.append({k: v.clone() for k, v in scene.state_dict().items()})
        original(scene, *rest)
        states.append({k: v.clone() for k, v in scene.state_dict().items()})

    monkeypatch.setattr(task, "run_stage", watched)
    failing(monkeypatch, loop, "losses_of", bad_loss, lambda i: True)
    task.train(small(data, tmp_path / "run"))
    for before, after in (states[:2], states[2:]):
        assert all(torch.equal(before[k], after[k]) for k in before)


def test_a_collapse_goes_back(data, tmp_path, monkeypatch):
    """The surface is lost between two reports: the state of the report before comes back."""
    monkeypatch.setattr(progress_module, "REPORT_SECONDS", -1.0)  # a report after every step
    monkeypatch.setattr(descent, "COPYING", 1e9)  # and a copy
    original, states = loop.held_out_psnr, []

    def judged(scene, *rest, **named):
        states.append(scene.field.sdf.detach().clone())
        if len(states) == 10:
            with torch.no_grad():
                scene.field.sdf.fill_(1.0)  # nothing is left
        return original(scene, *rest, **named)

    monkeypatch.setattr(loop, "held_out_psnr", judged)
    out = task.train(small(data, tmp_path / "run"))
    (told,) = events(out)
    assert "validation PSNR is" in told
    assert "dB); returned to the last good state" in told
    # One step, of half the length, lies between what came back and the next look
    assert (states[10] - states[8]).abs().max() < 0.5 * (states[8] - states[0]).abs().max()
    lines = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    assert lines[-1]["troubles"] == [told]


JOINT = JointConfig(
    iterations=40, rounds=2, points=200, newton_points=100, newton_steps=1, rays=64, tracing=1
)


def bad_joint(terms, scene):
    return terms | {"bad": terms["joint"] * float("nan")}


@pytest.mark.parametrize(
    ("bad", "troubles", "last"), [({5}, 1, 39), (range(5, 40), LIMIT + 1, 5 + LIMIT)]
)
def test_failures_in_the_joint_stage(monkeypatch, bad, troubles, last):
    scene, steps = sphere_scene(32), Steps(40)
    failing(monkeypatch, joint_solve, "objective", bad_joint, lambda i: i in bad)
    joint_solve.solve(scene, photos_of(8, 16), JOINT, 0, steps)
    assert finite(scene)
    assert len(steps.troubles) == troubles
    assert "step 5: the loss is nan; dropped this step" in steps.troubles[0]
    assert steps.abandoned == (troubles > LIMIT)
    assert steps.step == last


@pytest.mark.parametrize("gone", [True, False])
def test_a_surface_that_nobody_sees_leaves_light_and_materials(gone):
    scene, steps, photos = sphere_scene(8), Steps(10), photos_of(2, 8)
    steps.skip = lambda: steps.asked.append("skip")
    if gone:
        scene.field.sdf.data.fill_(1.0)
    else:
        photos = dataclasses.replace(photos, alpha=torch.zeros_like(photos.alpha))
    before = {k: v.clone() for k, v in scene.state_dict().items()}
    joint_solve.solve(scene, photos, JOINT, 0, steps)
    assert steps.asked == ["skip"]
    told = "the field has no surface" if gone else "no surface point is seen in any photograph"
    assert told in steps.troubles[0]
    assert all(torch.equal(before[k], v) for k, v in scene.state_dict().items())


@pytest.fixture
def followed():
    """A guard of one number, which is at 2, and its optimizer."""
    number = torch.tensor([2.0], requires_grad=True)
    optimizer = RowAdam([number], lr=0.1)
    steps = Steps(0)
    watch = Guard(steps)
    watch.follow(optimizer)
    return number, optimizer, steps, watch


def step(number, optimizer, watch, factor=1.0):
    optimizer.zero_grad()
    loss = (factor * number).sum()
    loss.backward()
    if watch.sound(loss):
        optimizer.step()


def test_failures_far_apart_are_not_in_a_row(followed):
    number, optimizer, steps, watch = followed
    for _ in range(LIMIT + 3):
        step(number, optimizer, watch, float("nan"))
        for _ in range(PROOF):
            step(number, optimizer, watch)
    assert len(steps.troubles) == LIMIT + 3
    assert not steps.abandoned
    assert all("dropped this step" in told for told in steps.troubles)
    assert watch.scale == 0.5 ** (LIMIT + 3)


def test_going_back_forgets_the_moments_and_says_so(followed):
    number, optimizer, _, watch = followed
    calls = []
    watch._restored = lambda: calls.append(None)
    for _ in range(5):
        step(number, optimizer, watch)
    assert number.item() == pytest.approx(1.5)
    for _ in range(2):
        step(number, optimizer, watch, float("inf"))
    assert number.item() == 2.0
    assert len(calls) == 1
    assert not optimizer.state


@pytest.mark.parametrize(
    ("sound", "collapsed", "told"),
    [
        # Of another kind of render; and what is beyond need
        (((30.0, False), (15.0, True), (25.0, False)), 18.0, "18.0 dB (best: 25.0 dB)"),
        ([(x, False) for x in (100.0, 41.0, 100.0, 36.0)], float("nan"), "nan dB (best: 40.0 dB)"),
    ],
)
def test_quality_that_may_fall_and_that_may_not(followed, sound, collapsed, told):
    _, _, steps, watch = followed
    for look in sound:
        watch.judge(*look)
    assert not steps.troubles
    watch.judge(collapsed, False)
    assert f"validation PSNR is {told}" in steps.troubles[0]


def test_a_copy_of_another_grid_is_not_taken(followed):
    _, optimizer, _, watch = followed
    grown = torch.tensor([1.0, 1.0], requires_grad=True)
    optimizer.param_groups[0]["params"][0] = grown
    watch.judge(20.0, False)
    watch.judge(1.0, False)
    assert grown.tolist() == [1.0, 1.0]


def test_a_copy_that_is_forgotten_is_not_taken(followed):
    """As when bricks have come in the room there was: same sizes, another meaning."""
    number, optimizer, steps, watch = followed
    for _ in range(3):
        step(number, optimizer, watch)
    before = number.item()
    watch.forget()
    watch.judge(20.0, False)  # takes a new copy
    watch.forget()
    watch.judge(1.0, False)
    assert number.item() == before
    assert "found no earlier state" in steps.troubles[0]


def test_a_system_is_damped_only_as_it_needs():
    g = torch.Generator().manual_seed(0)
    root = torch.randn(2, 5, 5, generator=g)
    good, right = root @ root.mT + torch.eye(5), torch.randn(2, 5, generator=g)
    exact = torch.linalg.solve(good.double(), right.double()[..., None])[..., 0]
    torch.testing.assert_close(
        equations.solve_damped(good, right).double(), exact, rtol=1e-5, atol=1e-6
    )
    flat = torch.zeros(3, 3)
    flat[0, 0] = 2.0  # two unknowns of which nothing is known
    x = equations.solve_damped(flat, torch.tensor([2.0, 0.0, 0.0]))
    torch.testing.assert_close(x, torch.tensor([1.0, 0.0, 0.0]), rtol=1e-5, atol=0)
    bent = torch.diag(torch.tensor([2.0, 1.0, -1e-3]))
    assert equations.solve_damped(bent, torch.ones(3)).isfinite().all()
    assert equations.solve_damped(flat * float("nan"), torch.ones(3)) is None
    assert equations.solve_damped(flat, torch.tensor([float("inf"), 0.0, 0.0])) is None


def test_a_newton_round_without_a_solution_leaves_the_map(monkeypatch):
    scene = sphere_scene(32)
    problem = problem_on_a_sphere(100, 12, 32, scene)
    monkeypatch.setattr(newton.equations, "solve_damped", lambda *_: None)
    solved = newton.newton_round_(scene, problem, no_metal(problem), JOINT)
    assert solved == newton.NewtonRound(troubles=[newton.UNSOLVABLE])
    assert (scene.sky.log_radiance == 0).all()


def looks(patience, quality, steps=1000, physical_from=0.0):
    """Progress at the looks, and where the plateau was seen."""
    plateau, when, flat = Plateau(patience), [], []
    for i in range(steps):
        done = i / steps
        if plateau.due(done):
            when.append(done)
            if plateau.flat(done, quality(done), done >= physical_from):
                flat.append(done)
    return when, flat


def test_where_there_is_no_plateau():
    """Rising quality, another kind of render, which counts anew; and without patience."""
    when, flat = looks(0.1, lambda done: 20 + 10 * done)
    assert not flat
    assert len(when) == pytest.approx(1 / CHECK, abs=1)
    _, flat = looks(0.1, lambda done: 20 + 10 * done - 9 * (done > 0.5), physical_from=0.5)
    assert not flat
    assert looks(0.0, lambda done: 20.0) == ([], [])


def test_a_plateau_is_seen_once_and_then_nothing_is_looked_at():
    when, flat = looks(0.1, lambda done: 20 + 10 * min(done, 0.4))
    assert flat == [when[-1]]
    assert 0.4 < flat[0] <= 0.4 + (WINDOW + 1) * CHECK


def test_a_training_that_gains_too_little_is_shortened(data, tmp_path):
    light = SGConfig(lobes=2, hidden=8, directions=16, directions_eval=16)
    stage = plain_stage(voxels=0.008, iterations=60, share=1.0, rays=128, physical_from=0.0)
    sizes = SceneConfig(4, material_channels=2, hidden=8, sky_nodes=16, light=light)
    cfg = plain_training(data, tmp_path / "run", (stage,), minutes=2.0, scene=sizes, patience=50.0)
    state = load_checkpoint(train(cfg))[1]
    assert state["early"] == [0]
    assert state["made"][0] < 0.6
    cfg = dataclasses.replace(cfg, patience=0.0, out=tmp_path / "whole")
    assert load_checkpoint(train(cfg))[1]["made"] == [1.0]
