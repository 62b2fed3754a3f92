"""The stage that solves for one map: its answers against truth, its order, its ends."""

from dataclasses import asdict, replace

import pytest
import torch
from analytic import photos_of, scene_of, sphere_scene
from observed_points import (
    BLUE,
    RED,
    Steps,
    lamps,
    no_metal,
    photographed,
    photographs_under,
    problem_on_a_sphere,
    random_problem,
    sphere_of,
)
from plain import plain_stage, plain_training, small_scene
from torch.nn.functional import normalize

from univoxel import brdf
from univoxel.cli import trainer as train_task
from univoxel.color import luminance
from univoxel.config import JointConfig
from univoxel.optim import RowAdam
from univoxel.render.observations import MaterialLabels, Mirrors, prefiltered_roughness
from univoxel.render.pipeline import extract_mesh
from univoxel.scene import load_checkpoint
from univoxel.training import joint_solve, progress
from univoxel.training.newton import NewtonRound, newton_round_

CFG = JointConfig(newton_points=400, newton_views=8, newton_steps=6)


def test_a_run_that_was_cut_traces_fewer_points(monkeypatch):
    asked = []

    def build_problem(scene, photos, cfg, seed):
        asked.append(cfg.points)
        return problem_on_a_sphere(1, 1, 8)

    monkeypatch.setattr(joint_solve, "build_problem", build_problem)
    for pace in (1.0, 0.5, 0.0):
        steps = Steps(0)
        steps.pace = pace
        joint_solve.solve(sphere_scene(8), photos_of(1, 8), JointConfig(points=10000), 0, steps)
    assert asked == [10000, 5000, joint_solve.MIN_POINTS]


@pytest.mark.parametrize("metal", [False, True])
def test_only_what_is_taken_for_metal_can_be_metal(metal):
    scene = scene_of((0.5, 0.5, 0.5), 0.4, 32)
    problem = problem_on_a_sphere(20, 8, 32, scene)
    decisions = MaterialLabels(torch.full((20,), metal))
    with torch.no_grad():
        scene.material.net[-1].bias[4] = 0.0
    joint_solve.objective(scene, problem, decisions, CFG)["joint"].backward()
    slope = scene.material.net[-1].bias.grad
    assert slope[:4].abs().min() > 0
    assert (slope[4] != 0) == metal


def test_metal_is_learned_where_it_is():
    """Under a known map with lamps: copper on one side of the sphere, a dielectric on the other."""
    torch.manual_seed(3)
    nodes, count = 64, 600
    problem = problem_on_a_sphere(count, 12, nodes)
    map = 0.3 + 4 * (torch.rand(nodes, 3) < 0.1)
    copper = problem.observations.normal[:, 0] > 0
    base = torch.where(
        copper[:, None], torch.tensor([0.95, 0.6, 0.4]), torch.tensor([0.4, 0.5, 0.6])
    )
    shown = prefiltered_roughness(torch.full((count,), 0.3), nodes)
    albedo, f0 = brdf.split(base, copper.float())
    problem = photographed(problem, map, albedo, shown, f0)
    scene = sphere_scene(nodes)
    problem = replace(problem, sky=scene.sky)
    with torch.no_grad():
        scene.sky.log_radiance.copy_(map.log())
    optimizer = RowAdam(
        [{"params": [scene.field.features], "lr": 0.03}, {"params": scene.material.parameters()}],
        lr=3e-3,
    )
    for _ in range(300):
        optimizer.zero_grad(set_to_none=True)
        terms = joint_solve.objective(scene, problem, MaterialLabels(copper), CFG)
        torch.stack(list(terms.values())).sum().backward()
        optimizer.step()
    features = scene.field.sample(problem.observations.position).features
    found, _, metallic = (m.detach() for m in scene.material(features))
    inside = problem.observations.normal[:, 0].abs() > 0.2
    assert metallic[inside & copper].mean() > 0.9
    assert metallic[inside & ~copper].mean() < 0.05
    assert (found - base)[inside].abs().mean() < 0.05


def test_solve_recovers_albedo_and_map():
    nodes, roughness = 128, 0.29
    true = lamps(nodes)
    true = true * true.mean() / true.mean(0)  # white on the whole, as cameras balance it
    photos = photographs_under(true, roughness)
    scene = sphere_scene(nodes)
    before = {k: v.clone() for k, v in scene.state_dict().items()}
    cfg = JointConfig(points=1500, newton_points=1000, rays=1024, tracing=1, rounds=3, lr_sdf=0.0)
    joint_solve.solve(scene, photos, cfg, 0, Steps(300))
    after = scene.state_dict()
    changed = {k.split(".")[0] for k in after if not torch.equal(after[k], before[k])}
    assert changed == {"field", "material", "sky"}
    assert torch.equal(after["field.sdf"], before["field.sdf"])  # no rate, no step

    mesh = extract_mesh(scene)
    x = mesh.vertices[:, 0]
    ratio = torch.stack([mesh.albedo[x > 0.1].mean(0) / RED, mesh.albedo[x < -0.1].mean(0) / BLUE])
    # Only the highlights tell how bright light and albedo are apart, and roughness blurs them:
    # one factor, the inverse of the light's, is far less certain than all the rest
    scale = ratio.mean()
    assert 0.65 < scale < 1.4
    assert (ratio / scale - 1).abs().max() < 0.08
    assert mesh.albedo[x > 0.1].std(0).max() < 0.05
    error = (scene.sky.radiance.detach() * scale / true).log()
    assert error.mean().abs() < 0.1
    assert error.std() < 0.3  # of a map whose logarithm varies by 0.7
    assert true.log().std() > 0.6


def test_bumps_that_shading_contradicts_are_smoothed():
    """The sphere with dents of half a voxel, 7 degrees of its normals, photographed without."""
    photos, scene = photographs_under(lamps(128), 0.29), sphere_scene(128)
    place = torch.arange(scene.field.grid.size[0]) / 1.5
    bump = place.sin()[:, None, None] * place.sin()[:, None] * place.cos()
    with torch.no_grad():
        scene.field.sdf += 0.5 * scene.field.voxel_size * bump
    at = 0.5 * normalize(torch.randn(2000, 3), dim=1)

    def off() -> float:
        normal = normalize(scene.field.sample(at).gradient.detach(), dim=1)
        return float(torch.rad2deg((normal * at * 2).sum(1).clamp(-1, 1).acos()).mean())

    before = off()
    occluder = scene.occluder()
    cfg = JointConfig(points=1500, newton_points=500, rays=1024, tracing=1, rounds=2)
    joint_solve.solve(scene, photos, cfg, 0, Steps(200))
    assert off() < 0.75 * before  # some is left: pixels are three quarters of a voxel wide
    moved = scene.field.sample(at).sdf.abs().mean()
    assert moved < 0.3 * scene.field.voxel_size  # it turns, and stays where it is
    assert scene.occluder() is not occluder  # what is derived from the surface is made anew


def test_a_training_that_is_stopped_and_out_of_time_traces_nothing():
    steps = Steps(10)
    steps.finished = True
    steps.over, steps.skip = True, lambda: steps.asked.append("skip")
    joint_solve.solve(sphere_scene(8), photos_of(1, 8), JointConfig(), 0, steps)
    assert steps.asked == ["skip"]


@pytest.mark.parametrize(
    ("rooms", "newton", "asked"),
    [((), [0, 0.25, 0.5, 0.75], [3, 2, 1, 0]), ((1, 0), [0, 0.5], [3, 0]), ((0,), [0], [3])],
)
def test_rounds_spread_over_the_steps_that_are_left(monkeypatch, rooms, newton, asked):
    """With less room than rounds there are fewer rounds, each of them longer."""
    steps, when, rates, made = Steps(400, rooms), [], [], []

    class Optimizer(RowAdam):
        def __init__(self, *arguments, **options):
            super().__init__(*arguments, **options)
            rates.append([])

        def step(self):
            rates[-1].append(self.param_groups[0]["lr"])
            made.append(None)

    def newton_round_(*_):
        when.append(len(made) / steps.count)
        return NewtonRound()

    def objective(scene, *_):
        return {"joint": scene.sky.log_radiance.square().sum()}

    scene = sphere_scene(8)
    for name, stand_in in {
        "build_problem": lambda *_: random_problem(nodes=8, scene=scene),
        "objective": objective,
        "RowAdam": Optimizer,
        "find_metal": lambda *_: torch.zeros(5, dtype=torch.bool),
        "initialise_": lambda scene, problem, decisions, *_: (decisions, []),
        "newton_round_": newton_round_,
    }.items():
        monkeypatch.setattr(joint_solve, name, stand_in)
    cfg = JointConfig(rounds=4, lr_sdf=0.0)  # the objective above says nothing of the surface
    joint_solve.solve(scene, photos_of(1, 8), cfg, 0, steps)
    assert when == newton
    assert steps.asked == asked
    for rate in rates:  # every round runs through the whole of its schedule
        assert rate[0] == cfg.lr_features
        assert rate[-1] == pytest.approx(0.1 * cfg.lr_features, rel=0.03)  # of 100 steps, the last


@pytest.fixture
def events(monkeypatch):
    """What two rounds on a small problem do, in their order, where each part changes nothing."""

    def solve(told, paint=False, whole=False, found=False, **changes):
        scene, told_of = scene_of((0.5, 0.5, 0.5), 0.4, 12), []
        sharp = torch.ones(5, dtype=torch.bool)
        mirrors = Mirrors(sharp, sharp, torch.eye(3)[[0] * 5], torch.full((5, 3), 0.8))
        objective = joint_solve.objective

        def does(what, result=None):
            return lambda *_: told_of.append(what) or result

        def newton(scene, problem, decisions, *_):
            starts = ", from albedos" * (decisions.albedo is not None)
            told_of.append("newton" + ", all metal" * bool(decisions.metal.all()) + starts)
            return NewtonRound()

        def adam(scene, problem, decisions, cfg):
            told_of.append("adam" + ", all metal" * bool(decisions.metal.all()))
            return objective(scene, problem, decisions, cfg)

        for name, stand_in in {
            "build_problem": lambda *_: random_problem(scene=scene),
            "find_metal": lambda *_: torch.zeros(5, dtype=torch.bool),
            "find_mirrors": lambda *_: mirrors if found else None,
            "evidence": lambda *_: torch.zeros(5),
            "initialise_": lambda s, p, found, *_: (replace(found, only_metal=whole), []),
            "fit_sun_": lambda *_: None,
            "diffuse_albedo": lambda *_: torch.full((5, 3), 0.3),
            "minimise_entropy_": does("entropy", paint),
            "teach_albedo_": does("albedos"),
            "teach_mirrors_": does("mirrors"),
            "neutralise_": does("neutral"),
            "set_level_": does("level"),
            "newton_round_": newton,
            "objective": adam,
        }.items():
            if not (name == "initialise_" and changes.get("only_metal")):
                monkeypatch.setattr(joint_solve, name, stand_in)
        cfg = replace(CFG, rounds=2, **({"colors": False} | changes))
        joint_solve.solve(scene, photos_of(1, 8), cfg, 0, told)
        return told_of

    return solve


def test_paint_that_changes_much_is_no_mirror(monkeypatch):
    """Around the highlight of a sun it changes as a mirror does, and still looks like paint."""
    scene = scene_of((0.5, 0.5, 0.5), 0.4, 12)
    problem, no = random_problem(scene=scene), torch.zeros(5, dtype=torch.bool)
    mirrors = Mirrors(~no, ~no, torch.eye(3)[[0] * 5], torch.full((5, 3), 0.8))
    paint = torch.tensor([0.8, 0.8, 0.0, -0.5, 0.8])
    monkeypatch.setattr(joint_solve, "find_mirrors", lambda *_: mirrors)
    monkeypatch.setattr(joint_solve, "find_metal", lambda *_: no)
    monkeypatch.setattr(joint_solve, "evidence", lambda *_: paint)
    labels = joint_solve.with_metals(scene, problem, MaterialLabels(no), CFG, 1.0)
    assert labels.metal.tolist() == [False, False, True, True, False]
    assert torch.equal(labels.mirrors.sharp, labels.metal)
    assert torch.equal(labels.mirrors.base.amax(1) > 0, labels.metal)
    monkeypatch.setattr(joint_solve, "evidence", lambda *_: torch.ones(5))
    assert joint_solve.with_metals(scene, problem, MaterialLabels(no), CFG, 1.0).mirrors is None
    known = replace(MaterialLabels(no), only_metal=True)
    assert joint_solve.with_metals(scene, problem, known, CFG, 1.0).mirrors is mirrors


def within(**known) -> Steps:
    """A training that goes on in its second round."""
    told = Steps(4)
    told.within = asdict(joint_solve.Within(0.0, 0.5, rounds_after=1, solved=True, **known))
    return told


ADAM, METAL = ["adam"] * 2, ["adam, all metal"] * 2
KNOWN = {"only_metal": True, "newton_steps": 1}
OF_METAL = ["neutral", "newton, all metal", *METAL]


@pytest.mark.parametrize(
    ("told", "options", "wanted"),
    [
        # Newton starts from the albedos under a map that the materials do not follow yet
        (
            Steps(4),
            {"colors": True, "paint": True},
            [
                *("entropy", "newton, from albedos", "entropy", "albedos", *ADAM),
                *("newton", "entropy", *ADAM),
            ],
        ),
        (
            Steps(4),
            {"colors": True},
            ["entropy", "newton", "entropy", *ADAM, "newton", "entropy", *ADAM],
        ),
        (Steps(4), {}, ["newton", *ADAM] * 2),
        (
            Steps(4),
            {"found": True},
            ["newton", "mirrors", *METAL, "newton, all metal", "mirrors", *METAL],
        ),
        # Light on metal alone is neutral in every round
        (Steps(4), KNOWN, OF_METAL * 2),
        (Steps(4), {"whole": True}, ["neutral", "newton", *METAL, *OF_METAL]),
        # What is known to be metal stays so where nothing is solved, and in a run that goes on
        (Steps(4), KNOWN | {"newton_steps": 0}, OF_METAL * 2),
        (within(), KNOWN, [*METAL, *OF_METAL]),
        (within(only_metal=True), {}, [*METAL, *OF_METAL]),
    ],
)
def test_what_a_round_does_and_when(events, told, options, wanted):
    assert events(told, **options) == [*wanted, "level"]


def test_training_says_and_keeps_that_there_is_nothing_but_metal(events, monkeypatch):
    told, kept, set_rates_ = Steps(4), [], joint_solve.set_rates_
    monkeypatch.setattr(
        joint_solve,
        "set_rates_",
        lambda *a: kept.append(told.within["only_metal"]) or set_rates_(*a),
    )
    events(told, whole=True)
    assert kept == [True] * 4  # for a run that goes on within the stage
    assert told.said[0].startswith("the whole object is classified as metal")
    assert told.said[0].endswith("use --metal some")
    told = Steps(4)
    events(told, only_metal=True)
    assert not told.said  # it was asked for


def test_the_solve_starts_glossy(monkeypatch):
    scene, problem = sphere_of((0.5, 0.5, 0.5), 0.6, 0.6)
    monkeypatch.setattr(joint_solve, "initialise_", lambda s, p, decisions, *_: (decisions, []))
    labels, cfg = no_metal(problem), replace(CFG, colors=False)
    joint_solve.start_(scene, problem, labels, cfg, 1.0, Steps(1))
    roughness = scene.material(scene.field.features_at(problem.observations.position))[1]
    assert roughness.median().item() == pytest.approx(joint_solve.GLOSSY)


def test_roughness_follows_newtons_points():
    """By what they changed, not to where they are: they are some of the points."""
    scene, problem = sphere_of((0.4, 0.3, 0.2), 0.4, 0.4)
    features = scene.field.features_at(problem.observations.position)
    before = [m.detach() for m in scene.material(features)]
    joint_solve.follow_(scene, problem, NewtonRound([1.0], to_roughness=0.2))
    albedo, roughness, metallic = scene.material(features)
    torch.testing.assert_close(roughness.median(), before[1].median() + 0.2)
    assert torch.equal(albedo, before[0])
    assert torch.equal(metallic, before[2])


def taught(teach, *arguments):
    """Materials of a sphere before and after a lesson from features that are 0."""
    torch.manual_seed(0)
    scene = sphere_scene(12)
    problem = problem_on_a_sphere(600, 4, 12, scene)
    position = problem.observations.position
    before = scene.material(scene.field.features_at(position))
    cfg = replace(CFG, rays=512, lr_features=0.2, lr_networks=0.03)
    teach(scene, problem, *(a(problem.observations.normal) for a in arguments), cfg)
    after = scene.material(scene.field.features_at(position))
    materials = ([m.detach() for m in several] for several in (before, after))
    return problem.observations.normal, *materials


def test_materials_follow_a_map_that_was_changed(monkeypatch):
    """Albedo goes to what the photographs say; the rest, metals, and what none sees stay."""

    def told(_, problem):
        normal = problem.observations.normal
        said = torch.where(normal[:, :1] > 0, RED, BLUE)
        said[:20], said[normal[:, 2] > 0.5] = torch.nan, 1.0
        return said

    monkeypatch.setattr(joint_solve, "diffuse_albedo", told)
    normal, before, after = taught(
        joint_solve.teach_albedo_, lambda normal: MaterialLabels(normal[:, 2] > 0.5)
    )
    wanted = torch.where(normal[:, :1] > 0, RED, BLUE)
    # Between red, blue and metal features are mixed
    matte, held = (normal[:, 0].abs() > 0.3) & (normal[:, 2] < 0.2), normal[:, 2] > 0.8
    off, error = ((albedo - wanted).abs().mean(1) for albedo in (before[0], after[0]))
    assert error[matte].mean() < 0.2 * off[matte].mean()
    assert (after[0] - before[0]).abs()[held].mean() < 0.2 * off[held].mean()
    for now, was in zip(after[1:], before[1:], strict=True):
        assert (now - was).abs().mean() < 0.02


def test_mirrors_are_learned_and_do_not_pull_the_rest_along():
    base = torch.tensor([0.9, 0.6, 0.3]).expand(600, 3)

    def mirrors(normal):
        return Mirrors(normal[:, 2] > 0.5, normal[:, 2] > 0.5, normal, base)

    normal, before, after = taught(joint_solve.teach_mirrors_, mirrors)
    albedo, roughness, metallic = after
    inside, outside = normal[:, 2] > 0.8, normal[:, 2] < 0.2
    assert (albedo - base)[inside].abs().mean() < 0.1
    assert roughness[inside].mean() < 0.05 + 0.2 * (before[1][inside].mean() - 0.05)
    assert metallic[inside].mean() > 0.5  # from 0.02; the solve goes on with it
    for now, was in zip((albedo, roughness, metallic), before, strict=True):
        assert (now - was)[outside].abs().mean() < 0.02


def test_without_paint_materials_stay(monkeypatch):
    scene = scene_of((0.5, 0.5, 0.5), 0.4, 12)
    problem = problem_on_a_sphere(50, 4, 12, scene)
    before = {k: v.clone() for k, v in scene.state_dict().items()}
    joint_solve.teach_albedo_(scene, problem, MaterialLabels(torch.ones(50, dtype=torch.bool)), CFG)
    after = scene.state_dict()
    assert all(torch.equal(after[k], before[k]) for k in after)


STAGE = plain_stage(voxels=0.01, iterations=10, share=0.4, rays=256, physical_from=0.5)
JOINT = JointConfig(iterations=20, points=300, newton_points=100, rays=256, tracing=1)


def training(data, tmp_path, *stages):
    sizes = small_scene(sky_nodes=32)
    return plain_training(data, tmp_path / "run", stages, minutes=60.0, scene=sizes)


def test_a_solve_that_was_killed_goes_on_in_its_round(data, tmp_path, monkeypatch):
    """Map, materials and round are those of the checkpoint; nothing before is done again."""
    cfg = training(data, tmp_path, STAGE, replace(JOINT, iterations=30, rounds=3))
    started, newtons, steps, objective = [], [], [], joint_solve.objective

    def killed(*arguments):
        steps.append(arguments[0].sky.log_radiance.detach().clone())
        if len(steps) == 15:  # of 10 in a round
            raise KeyboardInterrupt
        return objective(*arguments)

    def noted(name, when):
        original = getattr(joint_solve, name)
        monkeypatch.setattr(joint_solve, name, lambda *a: when.append(len(steps)) or original(*a))

    monkeypatch.setattr(progress, "CHECKPOINT_SECONDS", 0.0)  # after each step
    monkeypatch.setattr(joint_solve, "objective", killed)
    noted("initialise_", started)
    noted("newton_round_", newtons)
    with pytest.raises(KeyboardInterrupt):
        train_task.train(cfg)
    _, saved = load_checkpoint(cfg.out)
    assert saved["stage"] == 1
    assert saved["stage_steps"] == 13  # saved before its step was counted
    assert saved["within"]["rounds_after"] == 1
    assert saved["within"]["level"] > 0
    train_task.train(cfg, resume=True)
    assert started == [0]
    assert newtons[:2] == [0, 10]  # that of the second round is not made again
    # What is left of its 10 steps, or by rounding one more
    assert newtons[2:] in ([15 + 7], [15 + 8])
    assert len(steps) == 15 + 30 - 13
    assert torch.equal(steps[15], steps[14])  # the map goes on where it was
    assert load_checkpoint(cfg.out)[1]["within"] is None


def test_a_refit_leaves_materials_bit_for_bit(data, tmp_path, monkeypatch):
    refit = replace(STAGE, refit=True, physical_from=0.0)
    run_stage, states = train_task.run_stage, []

    def watched(scene, *rest):
        states.append({k: v.clone() for k, v in scene.state_dict().items()})
        run_stage(scene, *rest)
        states.append({k: v.clone() for k, v in scene.state_dict().items()})

    monkeypatch.setattr(train_task, "run_stage", watched)
    train_task.train(training(data, tmp_path, replace(STAGE, iterations=30), JOINT, refit))
    start, formed, before, after = states
    kept = {k for k in after if torch.equal(before[k], after[k])}
    assert "sky.log_radiance" in kept
    assert "field.sdf" not in kept  # silhouettes are put right
    assert {k for k in after if k.startswith("material.")} <= kept
    assert not {k for k in after if k.startswith(("light.", "radiance.")) and "weight" in k} & kept
    features = before["field.features"], after["field.features"]
    assert torch.equal(features[0][..., :2], features[1][..., :2])
    assert not torch.equal(features[0][..., 2:], features[1][..., 2:])
    # The stages before are what these could have stood still through
    assert not torch.equal(start["field.sdf"], formed["field.sdf"])
    assert not torch.equal(formed["field.sdf"], before["field.sdf"])
    assert not torch.equal(formed["field.features"], before["field.features"])
    assert not torch.equal(formed["sky.log_radiance"], before["sky.log_radiance"])


def levelled(albedo=None, tint=(1.0, 1.0, 1.0), metals=0, evidence=0.0):
    """Albedo before and after `set_level_`, and the mean of the map after it: of a sphere of such a
    median albedo under a map of such a colour, of which the first points are metal.

    What photographs show, the product of map and albedo, stays."""
    scene, problem = sphere_of((0.1, 0.1, 0.1), 0.5, 0.5)
    features = scene.field.features_at(problem.observations.position)
    with torch.no_grad():
        if albedo is not None:
            scene.material.shift_albedo(features, torch.full((3,), albedo))
        mean = scene.sky.radiance.mean(0)
        scene.sky.log_radiance.add_((torch.tensor(tint) * mean.mean() / mean).log())
        before = scene.material(features)[0]
        shown = scene.sky.radiance * before.median(0).values
        joint_solve.set_level_(scene, problem, torch.arange(len(features)) < metals, evidence)
        after = scene.material(features)[0]
        product = scene.sky.radiance * after.median(0).values
        torch.testing.assert_close(product, shown, rtol=1e-3, atol=0)
        return before, after, scene.sky.radiance.mean(0)


@pytest.mark.parametrize(
    ("metal", "evidence", "wanted", "share"),
    [
        (False, 0.0, joint_solve.ORDINARY, 1.0),  # nothing tells: an ordinary albedo
        (False, joint_solve.LEVEL, joint_solve.ORDINARY, 0.5),  # halfway, in logarithms
        (False, 1e3, joint_solve.ORDINARY, 0.0),  # photographs tell
        (True, 1e3, joint_solve.ORDINARY_METAL, 1.0),  # they never do
    ],
)
def test_the_level_of_light_and_albedo(metal, evidence, wanted, share):
    """The map becomes white as far as the level is not told."""
    tint = torch.tensor([1.3, 1.0, 0.7])
    before, albedo, left = levelled(0.1, tint.tolist(), 10**6 * metal, evidence)
    before, kept = before * tint**share, tint ** (1 - share)
    torch.testing.assert_close(left / left.mean(), kept / kept.mean())
    level = before.mean(0).max() if metal else luminance(before).mean()
    expected = before.mean(0) * (wanted / level) ** share
    torch.testing.assert_close(albedo.mean(0), expected, rtol=0.01, atol=0)


def test_what_bounds_the_level(monkeypatch):
    """Bright albedo stays; where the colour of light would make it brighter than white paint, both
    stay darker; and metal parts would come out brighter than any metal is."""
    before, after, _ = levelled()
    assert before.mean() > joint_solve.ORDINARY
    torch.testing.assert_close(after, before)
    _, after, _ = levelled(0.85, (1.4, 0.95, 0.65))
    assert after.median(0).values.max() < joint_solve.WHITE + 0.01
    monkeypatch.setattr(joint_solve, "ORDINARY_METAL", 0.15)
    _, after, _ = levelled(0.1, metals=99)
    torch.testing.assert_close(after.mean(), torch.tensor(0.15), rtol=0.01, atol=0)


def test_highlights_tell_the_level_and_roughness_hides_it():
    levels = {}
    for roughness in (0.2, 0.9):
        scene, problem = sphere_of((0.3, 0.3, 0.3), 0.0, roughness)
        every = MaterialLabels(torch.zeros(len(problem.observations.position), dtype=torch.bool))
        levels[roughness] = newton_round_(scene, problem, every, CFG).level
    assert levels[0.2] > 5 * levels[0.9] > 0
