"""The stage that solves for one map: its equations against autograd, its answers against truth."""

import math
from dataclasses import asdict, replace

import pytest
import torch
from analytic import photos_of, scene_of, sphere_scene, write_scene
from observed_points import (
    BLUE,
    RED,
    Steps,
    facing,
    in_double,
    lamps,
    no_metal,
    photographed,
    photographs_under,
    problem_on_a_sphere,
    random_problem,
)
from torch.nn.functional import normalize

from univoxel import brdf
from univoxel.checkpoint import load_checkpoint
from univoxel.color import linear_to_srgb_unclipped
from univoxel.config import TrainConfig
from univoxel.joint import equations, newton, stage
from univoxel.joint.config import JointConfig, NewtonConfig
from univoxel.joint.newton import NewtonRound, newton_round_
from univoxel.joint.observations import (
    Decisions,
    Mirrors,
    prefiltered_roughness,
    sample_observations,
)
from univoxel.lights.sg import SGConfig
from univoxel.ops import shade_map
from univoxel.optim import RowAdam
from univoxel.render.pipeline import extract_mesh
from univoxel.scene import SceneConfig
from univoxel.sphere import fibonacci_sphere
from univoxel.tasks import train as train_task
from univoxel.training import progress
from univoxel.training.config import StageConfig

CAUCHY = NewtonConfig().cauchy


@pytest.fixture(params=["dielectric", "metal"])
def transport_and_map(request):
    """Transport in double, a map and albedos that do not explain it, some observations clipped."""
    problem, metal = random_problem(), request.param == "metal"
    map, albedo = 0.7 + 2.5 * torch.rand(12, 3), 0.2 + 0.6 * torch.rand(5, 3)
    problem = photographed(problem, map, *of_metal(metal, albedo, torch.full((5,), 0.3)))
    target = problem.target + 0.03 * torch.randn_like(problem.target)
    target = target.clamp_max(1.0)  # as photographs are
    problem = replace(problem, target=target)
    point, observation = torch.arange(5), torch.arange(20).view(5, 4)
    rough = torch.full((5,), 0.3)
    transport = newton.linear_transport(problem, point, observation, rough, metal)
    map = map * torch.linspace(1.6, 0.9, 12)[:, None]
    return in_double(transport), map.double(), albedo.log().double()


def of_metal(metal: bool, base: torch.Tensor, roughness: torch.Tensor):
    """Diffuse albedo, roughness and F0."""
    diffuse, f0 = brdf.split(base, torch.full((len(base),), float(metal)))
    return diffuse, roughness, f0


@pytest.mark.parametrize("metal", [False, True])
def test_transport_makes_what_the_shading_makes(metal):
    problem = random_problem()
    map, albedo, roughness = torch.rand(12, 3), torch.rand(5, 3), 0.2 + 0.6 * torch.rand(5)
    problem = photographed(problem, map, *of_metal(metal, albedo, roughness))
    point, which = torch.tensor([0, 2, 4]), torch.tensor([[3, 1], [9, 8], [18, 18]])
    transport = newton.linear_transport(problem, point, which, roughness[point], metal)
    radiance = radiance_of(transport, map, albedo[point])
    assert torch.allclose(radiance, problem.observations.color[which], rtol=1e-4, atol=1e-6)
    assert torch.equal(transport.target, problem.target[which])


def radiance_of(transport: equations.LinearTransport, map: torch.Tensor, albedo: torch.Tensor):
    sky = transport.diffuse_factor[..., None] * (transport.diffuse @ map)
    specular = transport.specular @ map + transport.specular_indirect
    return albedo[:, None] * (sky + transport.diffuse_indirect) + specular


def weights(transport: equations.LinearTransport, map: torch.Tensor, log_albedo: torch.Tensor):
    residual = transport.target - linear_to_srgb_unclipped(
        radiance_of(transport, map, log_albedo.exp())
    )
    weight = 1 / (1 + (residual / CAUCHY) ** 2)
    return torch.where((transport.target > equations.CLIPPED) & (residual < 0), 0.0, weight)


def test_equations_are_the_schur_complement_of_the_dense_system(transport_and_map):
    transport, map, log_albedo = transport_and_map
    weight = weights(transport, map, log_albedo)
    assert 0 < int((weight == 0).sum()) < weight.numel() / 2  # clipped observations are among them
    state = transport, map, log_albedo, CAUCHY
    eliminated, right, back = equations.normal_equations(*state)
    cost = 0.0
    for c in range(3):

        def encoded(x, a, c=c):
            light, albedo = map.clone(), log_albedo.exp()
            light[:, c], albedo[:, c] = x.exp(), a.exp()
            return linear_to_srgb_unclipped(radiance_of(transport, light, albedo))[..., c].flatten()

        x, a = map[:, c].log(), log_albedo[:, c]
        j_map, j_albedo = torch.autograd.functional.jacobian(encoded, (x, a))
        w = weight[..., c].flatten()
        residual = transport.target[..., c].flatten() - encoded(x, a)
        cost += (w * residual**2).sum()
        full = torch.cat([j_map, j_albedo], 1)
        hessian, gradient = full.T @ (w[:, None] * full), full.T @ (w * residual)
        own = hessian[12:, 12:] + 1e-6 * torch.eye(5)
        cross, inverse = hessian[:12, 12:], torch.linalg.inv(own)
        exact = {"rtol": 1e-6, "atol": 1e-9}  # double, but for float32 constants of the curve
        assert torch.allclose(eliminated[c], hessian[:12, :12] - cross @ inverse @ cross.T, **exact)
        assert torch.allclose(right[c], gradient[:12] - cross @ inverse @ gradient[12:], **exact)
        assert torch.allclose(back.gradient[c], gradient[12:], **exact)
        assert torch.allclose(back.curvature[c], own.diagonal(), **exact)
        assert torch.allclose(back.cross[c], cross.T, **exact)

        # One step of the eliminated system and what it says of the albedo: the dense solution
        damping = 1e-4 * torch.eye(12)
        dense = hessian.clone()
        dense[12:, 12:], dense[:12, :12] = own, hessian[:12, :12] + damping
        solution = torch.linalg.solve(dense, gradient)
        step = torch.linalg.solve(eliminated[c] + damping, right[c])
        change = (back.gradient[c] - back.cross[c] @ step) / back.curvature[c]
        assert torch.allclose(step, solution[:12], rtol=1e-4, atol=1e-7)
        assert torch.allclose(change, solution[12:], rtol=1e-4, atol=1e-7)
    assert back.cost == pytest.approx(float(cost), rel=1e-9)


def test_the_gradient_is_that_of_the_cost_at_fixed_weights(transport_and_map):
    transport, map, log_albedo = transport_and_map
    weight = weights(transport, map, log_albedo)

    def cost(log_map, log_albedo):
        radiance = radiance_of(transport, log_map.exp(), log_albedo.exp())
        residual = transport.target - linear_to_srgb_unclipped(radiance)
        return (weight * residual**2).sum()

    x, a = map.log(), log_albedo
    _, right, back = equations.normal_equations(transport, map, log_albedo, CAUCHY)
    h = 1e-5
    for node, c in ((0, 0), (5, 1), (11, 2)):
        step = torch.zeros_like(x)
        step[node, c] = h
        slope = (cost(x + step, a) - cost(x - step, a)) / (2 * h)
        # The elimination's share of the gradient put back
        g = right[c] + back.cross[c].T @ (back.gradient[c] / back.curvature[c])
        assert g[node].item() == pytest.approx(-slope.item() / 2, rel=1e-5, abs=1e-9)
    step = torch.zeros_like(a)
    step[3, 1] = h
    slope = (cost(x, a + step) - cost(x, a - step)) / (2 * h)
    assert back.gradient[1, 3].item() == pytest.approx(-slope.item() / 2, rel=1e-5, abs=1e-9)


def test_roughness_is_eliminated_by_the_schur_complement_too():
    """Of the dense system of three channels, which roughness ties to one another; in double."""
    problem = random_problem()
    true, albedo = 0.7 + 2.5 * torch.rand(12, 3), 0.2 + 0.6 * torch.rand(5, 3)
    problem = photographed(problem, true, albedo, torch.full((5,), 0.5))
    point, observation, by = torch.arange(5), torch.arange(20).view(5, 4), 0.02
    transport, rougher = (
        in_double(newton.linear_transport(problem, point, observation, rough, False))
        for rough in (torch.full((5,), 0.3), torch.full((5,), 0.3 + by))
    )
    map, log_albedo = (true * 1.2).double(), (0.9 * albedo).log().double()
    prior, deviation = 0.3, torch.linspace(-0.1, 0.2, 5).double()

    def encoded(x, a, rough):  # linear in roughness, as the equations take it
        state = x.view(12, 3).exp(), a.view(5, 3).exp()
        now, then = (radiance_of(t, *state) for t in (transport, rougher))
        return linear_to_srgb_unclipped(now + rough[:, None, None] / by * (then - now)).flatten()

    state = map.log().flatten(), log_albedo.flatten(), torch.zeros(5).double()
    jacobian = torch.cat(torch.autograd.functional.jacobian(encoded, state), 1)
    w = weights(transport, map, log_albedo).flatten()
    residual = transport.target.flatten() - encoded(*state)
    hessian, gradient = jacobian.T @ (w[:, None] * jacobian), jacobian.T @ (w * residual)
    hessian[36:51, 36:51] += 1e-6 * torch.eye(15)
    hessian[51:, 51:] += prior * torch.eye(5)
    gradient[51:] -= prior * deviation

    step = equations.RoughnessStep(rougher, by, prior, deviation)
    state = transport, map, log_albedo, CAUCHY
    own, right, back = equations.normal_equations(*state, None, step)
    coupling, from_gradient = equations.roughness_terms(back.roughness)
    system, right = torch.block_diag(*own) - coupling, (right - from_gradient).flatten()
    order = torch.arange(36).view(12, 3).T.flatten()  # channel after channel
    cross, inverse = hessian[:36, 36:], torch.linalg.inv(hessian[36:, 36:])
    exact = {"rtol": 1e-5, "atol": 1e-8}  # double, but for float32 constants of the curve
    complement = (hessian[:36, :36] - cross @ inverse @ cross.T)[order][:, order]
    assert torch.allclose(system, complement, **exact)
    assert torch.allclose(right, (gradient[:36] - cross @ inverse @ gradient[36:])[order], **exact)
    assert (own[0] - system[:12, :12]).abs().max() > 1e-3 * own[0].abs().max()  # it matters

    hessian[:36, :36] += 1e-4 * torch.eye(36)
    solution = torch.linalg.solve(hessian, gradient)
    step = torch.linalg.solve(system + 1e-4 * torch.eye(36), right)
    to_albedo, to_rough = back.back_substituted(step.view(3, 12))
    found = {"rtol": 1e-4, "atol": 1e-7}
    assert torch.allclose(step, solution[:36][order], **found)
    assert torch.allclose(to_albedo.flatten(), solution[36:51], **found)
    assert torch.allclose(to_rough, solution[51:], **found)


@pytest.mark.parametrize(("count", "size"), [(30, 12), (3, 10), (5, 1), (0, 4)])
def test_gram_is_the_product_with_the_transpose(count, size):
    matrix = torch.randn(count, size, dtype=torch.float64)
    torch.testing.assert_close(equations.gram(matrix), matrix.T @ matrix)


def test_prefiltered_lobes_cover_the_gap_between_nodes():
    roughness = torch.tensor([0.05, 0.3, 1.0])
    wide = prefiltered_roughness(roughness, 64)
    assert torch.allclose(wide**4 - roughness**4, torch.full((3,), 1 / 64), rtol=1e-4)
    # The mean over a gap of what point lights of 64 nodes make of a mirror: near the right one
    direction, normal = fibonacci_sphere(64), normalize(torch.randn(500, 3), dim=1)
    wo = facing(normal, 0.5)
    albedo, one = torch.zeros(500, 3), torch.ones(64, 3)
    seen = shade_map(
        one, torch.ones(500, 64), torch.zeros(500, 64, 3), torch.arange(500), normal, wo, albedo,
        wide[:1].expand(500), direction, 4 * math.pi / 64,
    )[:, 0]  # fmt: skip
    assert seen.std() < 0.5 * seen.mean()


def test_laplacian():
    direction = fibonacci_sphere(200)
    matrix = equations.graph_laplacian(direction, 6)
    assert (matrix.sum(1) == 0).all()
    assert torch.equal(matrix, matrix.T)
    assert (matrix.diagonal() >= 6).all()
    near = (direction[0] @ direction.T).topk(7).indices[1:]
    assert (matrix[0, near] == -1).all()
    assert (matrix - torch.diag(matrix.diagonal()) <= 0).all()
    # A smooth function costs little, an uneven one much: x' L x sums squared differences
    smooth, rough = direction[:, 2], torch.arange(200) % 2 * 2.0 - 1
    edges = 0.5 * (matrix.diagonal().sum())
    assert smooth @ matrix @ smooth < 0.1 * edges
    assert rough @ matrix @ rough > edges


def test_samples_are_points_that_are_seen_and_their_own_observations():
    torch.manual_seed(0)
    problem = problem_on_a_sphere(6, 1, 8)
    counts = torch.tensor([3, 0, 1, 0, 0, 5])
    offsets = torch.cat([torch.zeros(1, dtype=torch.int64), counts.cumsum(0)])
    seen = replace(problem.observations, offsets=offsets)
    problem = replace(problem, observations=seen)
    point, observation = sample_observations(problem, 300, 4)
    assert point.shape == observation.shape == (1200,)
    assert (point.view(300, 4) == point.view(300, 4)[:, :1]).all()
    owner = torch.repeat_interleave(counts)
    assert torch.equal(owner[observation], point)
    assert set(observation.tolist()) == set(range(9))  # each is drawn at times


CFG = JointConfig(newton_points=400, newton_views=8, newton_steps=6)


def test_newton_recovers_a_known_map():
    albedo, roughness, nodes = (0.5, 0.4, 0.3), 0.3, 64
    scene = scene_of(albedo, roughness, nodes)
    problem = problem_on_a_sphere(400, 12, nodes, scene)
    torch.manual_seed(2)
    true = (0.6 * torch.randn(nodes, 3)).exp() * 0.6
    shown = prefiltered_roughness(torch.full((400,), roughness), nodes)  # a node is a patch of sky
    problem = photographed(problem, true, torch.tensor(albedo).expand(400, 3), shown)
    costs = newton_round_(scene, problem, no_metal(problem), CFG).costs
    costs += newton_round_(scene, problem, no_metal(problem), CFG).costs
    assert len(costs) == 2 * CFG.newton_steps
    error = scene.sky.log_radiance.detach() - true.log()
    assert costs[-1] < 1e-3 * costs[0]
    # What is left is the smoothness, which this uneven map has none of
    assert error.abs().mean() < 0.25 * true.log().abs().mean()


def test_newton_finds_the_map_under_a_roughness_that_is_wrong():
    """Where roughness may change, the map is right; where it stays, the map takes the error on."""
    errors = []
    for free in (0.0, CFG.newton_roughness):
        nodes, albedo = 64, torch.tensor([0.5, 0.4, 0.3])
        scene = scene_of(tuple(albedo.tolist()), 0.45, nodes)
        problem = problem_on_a_sphere(400, 12, nodes, scene)
        shown = prefiltered_roughness(torch.full((400,), 0.3), nodes)
        problem = photographed(problem, lamps(nodes), albedo.expand(400, 3), shown)
        for _ in range(2):
            cfg = replace(CFG, newton_roughness=free)
            newton_round_(scene, problem, no_metal(problem), cfg)
        errors.append((scene.sky.log_radiance.detach() - lamps(nodes).log()).abs().mean())
    assert errors[1] < 0.5 * errors[0]  # not all: roughness has a pull to where it was


@pytest.mark.parametrize("views", [2, 3])
def test_newton_learns_from_few_photographs(views):
    albedo, roughness, nodes = (0.5, 0.4, 0.3), 0.3, 64
    scene = scene_of(albedo, roughness, nodes)
    problem = problem_on_a_sphere(400, views, nodes, scene)
    true = (0.6 * torch.randn(nodes, 3)).exp() * 0.6
    shown = prefiltered_roughness(torch.full((400,), roughness), nodes)
    problem = photographed(problem, true, torch.tensor(albedo).expand(400, 3), shown)
    costs = newton_round_(scene, problem, no_metal(problem), CFG).costs
    assert len(costs) == CFG.newton_steps
    assert costs[-1] < 0.1 * costs[0]


def test_newton_in_no_time_takes_few_points(monkeypatch):
    scene, counts = scene_of((0.5, 0.4, 0.3), 0.4, 32), []
    problem = problem_on_a_sphere(100, 12, 32, scene)
    equations = newton.normal_equations

    def counted(transport, *arguments):
        counts.append(len(transport.diffuse))
        return equations(transport, *arguments)

    monkeypatch.setattr(newton, "normal_equations", counted)
    monkeypatch.setattr(newton, "NEWTON_CHUNK", 20)
    cfg = replace(CFG, newton_steps=2)
    newton_round_(scene, problem, no_metal(problem), cfg, seconds=0.0)
    assert counts == [20] * (1 + cfg.newton_steps * cfg.newton.min_parts)  # one to measure
    counts.clear()
    newton_round_(scene, problem, no_metal(problem), cfg, seconds=1e3)
    assert counts == [20] * (1 + cfg.newton_steps * 5)


def test_a_run_that_was_cut_traces_fewer_points(monkeypatch):
    asked = []

    def build_problem(scene, photos, cfg, seed):
        asked.append(cfg.points)
        return problem_on_a_sphere(1, 1, 8)

    monkeypatch.setattr(stage, "build_problem", build_problem)
    for pace in (1.0, 0.5, 0.0):
        steps = Steps(0)
        steps.pace = pace
        stage.solve(sphere_scene(8), photos_of(1, 8), JointConfig(points=10000), 0, steps)
    assert asked == [10000, 5000, JointConfig().surface.min_points]


def test_no_steps_of_newton_leave_the_map():
    scene = scene_of((0.5, 0.5, 0.5), 0.4, 32)
    problem = problem_on_a_sphere(20, 8, 32, scene)
    cfg = replace(CFG, newton_steps=0)
    assert newton_round_(scene, problem, no_metal(problem), cfg, seconds=10.0) == NewtonRound()
    assert (scene.sky.log_radiance == 0).all()


def test_newton_without_rich_points_leaves_the_map():
    scene = scene_of((0.5, 0.5, 0.5), 0.4, 32)
    problem = problem_on_a_sphere(
        20, 1, 32, scene
    )  # of one observation the albedo explains everything
    assert newton_round_(scene, problem, no_metal(problem), CFG) == NewtonRound()
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
    torch.manual_seed(2)
    true = (0.6 * torch.randn(nodes, 3)).exp() * 0.6
    shown = prefiltered_roughness(torch.full((count,), roughness), nodes)
    diffuse, f0 = brdf.split(base.expand(count, 3), metal.float())
    problem = photographed(problem, true, diffuse, shown, f0)
    costs = newton_round_(scene, problem, Decisions(metal), CFG).costs
    costs += newton_round_(scene, problem, Decisions(metal), CFG).costs
    assert costs[-1] < 1e-3 * costs[0]
    error = scene.sky.log_radiance.detach() - true.log()
    # What is left is the smoothness, as above
    assert error.abs().mean() < 0.25 * true.log().abs().mean()


@pytest.mark.parametrize("metal", [False, True])
def test_only_what_is_taken_for_metal_can_be_metal(metal):
    scene = scene_of((0.5, 0.5, 0.5), 0.4, 32)
    problem = problem_on_a_sphere(20, 8, 32, scene)
    decisions = Decisions(torch.full((20,), metal))
    with torch.no_grad():
        scene.material.net[-1].bias[4] = 0.0
    stage.objective(scene, problem, decisions, CFG)["joint"].backward()
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
    for _ in range(400):
        optimizer.zero_grad(set_to_none=True)
        terms = stage.objective(scene, problem, Decisions(copper), CFG)
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
    photos = photographs_under(true, roughness)
    scene = sphere_scene(nodes)
    before = {k: v.clone() for k, v in scene.state_dict().items()}
    cfg = JointConfig(points=1500, newton_points=1000, rays=1024, tracing=1, rounds=3, lr_sdf=0.0)
    stage.solve(scene, photos, cfg, 0, Steps(700))
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
    stage.solve(scene, photos, cfg, 0, Steps(300))
    assert off() < 0.75 * before  # some is left: pixels are three quarters of a voxel wide
    moved = scene.field.sample(at).sdf.abs().mean()
    assert moved < 0.3 * scene.field.voxel_size  # it turns, and stays where it is
    assert scene.occluder() is not occluder  # what is derived from the surface is made anew


def test_no_time_is_no_tracing():
    steps = Steps(10)
    steps.over, steps.skip = True, lambda: steps.asked.append("skip")
    stage.solve(sphere_scene(8), photos_of(1, 8), JointConfig(), 0, steps)
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
    monkeypatch.setattr(stage, "build_problem", lambda *_: random_problem(nodes=8, scene=scene))
    monkeypatch.setattr(stage, "objective", objective)
    monkeypatch.setattr(stage, "RowAdam", Optimizer)
    monkeypatch.setattr(stage, "find_metal", lambda *_: torch.zeros(5, dtype=torch.bool))
    monkeypatch.setattr(stage, "initialise_", lambda scene, problem, decisions, *_: (decisions, []))
    monkeypatch.setattr(stage, "newton_round_", newton_round_)
    cfg = JointConfig(rounds=4, lr_sdf=0.0)  # the objective above says nothing of the surface
    stage.solve(scene, photos_of(1, 8), cfg, 0, steps)
    assert when == newton
    assert steps.asked == asked
    for rate in rates:  # every round runs through the whole of its schedule
        assert rate[0] == cfg.lr_features
        assert rate[-1] == pytest.approx(0.1 * cfg.lr_features, rel=0.03)  # of 100 steps, the last


@pytest.mark.parametrize("changed", [True, False])
def test_paint_is_asked_before_and_after_newton(monkeypatch, changed):
    """Newton starts from the albedos under a map that the materials do not follow yet."""
    calls, begun = [], []
    scene = scene_of((0.5, 0.5, 0.5), 0.4, 12)

    def newton_round_(scene, problem, decisions, *_):
        calls.append("newton")
        begun.append(decisions.albedo)
        return NewtonRound()

    def minimise_entropy_(*_):
        calls.append("entropy")
        return changed

    monkeypatch.setattr(stage, "build_problem", lambda *_: random_problem(scene=scene))
    monkeypatch.setattr(stage, "find_metal", lambda *_: torch.zeros(5, dtype=torch.bool))
    monkeypatch.setattr(stage, "initialise_", lambda scene, problem, decisions, *_: (decisions, []))
    monkeypatch.setattr(stage, "fit_sun_", lambda *_: None)
    monkeypatch.setattr(stage, "diffuse_albedo", lambda *_: torch.full((5, 3), 0.3))
    monkeypatch.setattr(stage, "teach_albedo_", lambda *_: calls.append("teach"))
    monkeypatch.setattr(stage, "minimise_entropy_", minimise_entropy_)
    monkeypatch.setattr(stage, "newton_round_", newton_round_)
    stage.solve(scene, photos_of(1, 8), replace(CFG, rounds=2), 0, Steps(4))
    first = ["entropy", "newton", "entropy", *["teach"] * changed]
    assert calls == [*first, "newton", "entropy"]
    assert [albedo is not None for albedo in begun] == [changed, False]
    calls.clear()
    stage.solve(scene, photos_of(1, 8), replace(CFG, rounds=2, colors=False), 0, Steps(4))
    assert calls == ["newton", "newton"]


def test_light_on_metal_alone_is_neutral_in_every_round(monkeypatch):
    calls = []
    scene = scene_of((0.5, 0.5, 0.5), 0.4, 12)

    def newton_round_(scene, problem, decisions, *_):
        calls.append(bool(decisions.metal.all()))
        return NewtonRound()

    monkeypatch.setattr(stage, "build_problem", lambda *_: random_problem(scene=scene))
    monkeypatch.setattr(stage, "neutralise_", lambda *_: calls.append("neutral"))
    monkeypatch.setattr(stage, "newton_round_", newton_round_)
    known = replace(CFG, rounds=2, colors=False, only_metal=True, newton_steps=1)
    stage.solve(scene, photos_of(1, 8), known, 0, Steps(4))
    assert calls == ["neutral", True] * 2


def test_a_solve_that_found_nothing_but_metal_goes_on_with_it(monkeypatch):
    calls = []
    scene = scene_of((0.5, 0.5, 0.5), 0.4, 12)
    objective = stage.objective

    def looked_at(scene, problem, decisions, cfg):
        calls.append(bool(decisions.metal.all()))
        return objective(scene, problem, decisions, cfg)

    monkeypatch.setattr(stage, "build_problem", lambda *_: random_problem(scene=scene))
    monkeypatch.setattr(stage, "neutralise_", lambda *_: calls.append("neutral"))
    monkeypatch.setattr(stage, "newton_round_", lambda *_: NewtonRound())
    monkeypatch.setattr(stage, "objective", looked_at)
    told = Steps(4)
    told.within = asdict(stage.Round(0.0, 0.5, rounds_after=1, solved=True, only_metal=True))
    stage.solve(scene, photos_of(1, 8), replace(CFG, rounds=2, colors=False), 0, told)
    assert calls == [True, True, "neutral", True, True]


def test_what_is_known_to_be_metal_stays_so_where_nothing_is_solved(monkeypatch):
    """Without steps of Newton, and in a run that goes on from before that was noted."""
    scene, metals, objective = scene_of((0.5, 0.5, 0.5), 0.4, 12), [], stage.objective

    def looked_at(scene, problem, decisions, cfg):
        metals.append(bool(decisions.metal.all()) and decisions.only_metal)
        return objective(scene, problem, decisions, cfg)

    monkeypatch.setattr(stage, "build_problem", lambda *_: random_problem(scene=scene))
    monkeypatch.setattr(stage, "objective", looked_at)
    cfg = replace(CFG, rounds=2, colors=False, only_metal=True, newton_steps=0)
    stage.solve(scene, photos_of(1, 8), cfg, 0, Steps(4))
    told = Steps(4)
    told.within = asdict(stage.Round(0.0, 0.5, rounds_after=1, solved=True))
    stage.solve(scene, photos_of(1, 8), cfg, 0, told)
    assert metals == [True] * 8


def test_training_says_and_keeps_that_there_is_nothing_but_metal(monkeypatch):
    scene, told = scene_of((0.5, 0.5, 0.5), 0.4, 12), Steps(4)
    monkeypatch.setattr(stage, "build_problem", lambda *_: random_problem(scene=scene))
    monkeypatch.setattr(stage, "newton_round_", lambda *_: NewtonRound())
    monkeypatch.setattr(
        stage, "initialise_", lambda s, p, decisions, *_: (replace(decisions, only_metal=True), [])
    )
    kept, set_rates_ = [], stage.set_rates_
    monkeypatch.setattr(
        stage, "set_rates_", lambda *a: kept.append(told.within["only_metal"]) or set_rates_(*a)
    )
    cfg = replace(CFG, rounds=2, colors=False)
    stage.solve(scene, photos_of(1, 8), cfg, 0, told)
    assert kept == [True] * 4  # for a run that goes on within the stage
    assert told.said[0].startswith("the whole object is taken for metal")
    assert told.said[0].endswith("see --metal")
    told = Steps(4)
    stage.solve(scene, photos_of(1, 8), replace(cfg, only_metal=True), 0, told)
    assert not told.said  # it was asked for


def test_mirrors_are_taught_before_adam_in_every_round(monkeypatch):
    calls, found = [], torch.ones(5, dtype=torch.bool)
    scene = scene_of((0.5, 0.5, 0.5), 0.4, 12)
    mirrors = Mirrors(found, found, torch.eye(3)[[0] * 5], torch.full((5, 3), 0.8))
    monkeypatch.setattr(stage, "build_problem", lambda *_: random_problem(scene=scene))
    monkeypatch.setattr(stage, "find_metal", lambda *_: found)
    monkeypatch.setattr(stage, "find_mirrors", lambda *_: mirrors)
    monkeypatch.setattr(stage, "initialise_", lambda scene, problem, decisions, *_: (decisions, []))
    monkeypatch.setattr(stage, "newton_round_", lambda *_: calls.append("newton") or NewtonRound())
    monkeypatch.setattr(stage, "teach_mirrors_", lambda *_: calls.append("teach"))
    cfg, told = replace(CFG, rounds=2, colors=False), Steps(4)
    stage.solve(scene, photos_of(1, 8), cfg, 0, told)
    assert calls == ["newton", "teach"] * 2
    assert not told.said
    monkeypatch.setattr(stage, "sharpen_sky_", lambda *args: args[3] is mirrors)
    stage.solve(scene, photos_of(1, 8), cfg, 0, told)
    assert told.said == ["the map of the light is as sharp as what is polished shows it"]


def test_materials_follow_a_map_that_was_changed(monkeypatch):
    """Albedo goes to what the photographs say; the rest, metals, and what none sees stay."""
    torch.manual_seed(0)
    scene = sphere_scene(12)
    problem = problem_on_a_sphere(600, 4, 12, scene)
    wanted = torch.where(problem.observations.normal[:, :1] > 0, RED, BLUE)
    told = wanted.clone()
    told[:20] = torch.nan
    metal = problem.observations.normal[:, 2] > 0.5
    told[metal] = 1.0
    monkeypatch.setattr(stage, "diffuse_albedo", lambda *_: told)
    features = scene.field.features_at(problem.observations.position)
    before = [m.detach() for m in scene.material(features)]
    cfg = replace(CFG, rays=512, lr_features=0.2, lr_networks=0.03)  # from features that are 0
    stage.teach_albedo_(scene, problem, Decisions(metal), cfg)
    after = scene.material(scene.field.features_at(problem.observations.position))
    # Between red, blue and metal features are mixed
    matte = (problem.observations.normal[:, 0].abs() > 0.3) & (
        problem.observations.normal[:, 2] < 0.2
    )
    held = problem.observations.normal[:, 2] > 0.8
    off = (before[0] - wanted).abs().mean(1)
    error = (after[0].detach() - wanted).abs().mean(1)
    assert error[matte].mean() < 0.2 * off[matte].mean()
    assert (after[0] - before[0]).abs()[held].mean() < 0.2 * off[held].mean()
    for now, was in zip(after[1:], before[1:], strict=True):
        assert (now - was).abs().mean() < 0.02


def test_mirrors_are_learned_and_do_not_pull_the_rest_along():
    torch.manual_seed(0)
    scene = sphere_scene(12)
    problem = problem_on_a_sphere(600, 4, 12, scene)
    height = problem.observations.normal[:, 2]
    sharp, base = height > 0.5, torch.tensor([0.9, 0.6, 0.3]).expand(600, 3)
    mirrors = Mirrors(sharp, sharp, problem.observations.normal, base)
    position = problem.observations.position
    before = [m.detach() for m in scene.material(scene.field.features_at(position))]
    cfg = replace(CFG, rays=512, lr_features=0.2, lr_networks=0.03)  # from features that are 0
    stage.teach_mirrors_(scene, problem, mirrors, cfg)
    albedo, roughness, metallic = (
        m.detach() for m in scene.material(scene.field.features_at(position))
    )
    inside, outside = height > 0.8, height < 0.2
    assert (albedo - base)[inside].abs().mean() < 0.1
    assert roughness[inside].mean() < 0.05 + 0.2 * (before[1][inside].mean() - 0.05)
    assert metallic[inside].mean() > 0.5  # from 0.02; the solve goes on with it
    for now, was in zip((albedo, roughness, metallic), before, strict=True):
        assert (now - was)[outside].abs().mean() < 0.02


def test_without_paint_materials_stay(monkeypatch):
    scene = scene_of((0.5, 0.5, 0.5), 0.4, 12)
    problem = problem_on_a_sphere(50, 4, 12, scene)
    before = {k: v.clone() for k, v in scene.state_dict().items()}
    stage.teach_albedo_(scene, problem, Decisions(torch.ones(50, dtype=torch.bool)), CFG)
    after = scene.state_dict()
    assert all(torch.equal(after[k], before[k]) for k in after)


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


def test_a_solve_that_was_killed_goes_on_in_its_round(tmp_path, monkeypatch):
    """Map, materials and round are those of the checkpoint; nothing before is done again."""
    data = write_scene(tmp_path / "data", views=8, size=24)
    light = SGConfig(lobes=4, hidden=16, directions=32, directions_eval=64)
    stages = (
        StageConfig(voxels=0.01, iterations=10, share=0.4, rays=256, physical_from=0.5),
        JointConfig(iterations=30, rounds=3, points=300, newton_points=100, rays=256, tracing=1),
    )
    sizes = SceneConfig(channels=4, material_channels=2, hidden=16, sky_nodes=32, light=light)
    cfg = TrainConfig(data, tmp_path / "run", stages, minutes=5.0, scene=sizes)
    started, newtons, steps = [], [], []
    initialise_, newton_round, objective = stage.initialise_, stage.newton_round_, stage.objective

    def killed(*arguments):
        steps.append(arguments[0].sky.log_radiance.detach().clone())
        if len(steps) == 15:  # of 10 in a round
            raise KeyboardInterrupt
        return objective(*arguments)

    monkeypatch.setattr(progress, "CHECKPOINT_SECONDS", 0.0)  # after each step
    monkeypatch.setattr(stage, "objective", killed)
    monkeypatch.setattr(
        stage, "initialise_", lambda *a: started.append(len(steps)) or initialise_(*a)
    )
    monkeypatch.setattr(
        stage, "newton_round_", lambda *a: newtons.append(len(steps)) or newton_round(*a)
    )
    with pytest.raises(KeyboardInterrupt):
        train_task.train(cfg)
    _, saved = load_checkpoint(cfg.out)
    assert saved["stage"] == 1
    assert saved["stage_steps"] == 13  # saved before its step was counted
    assert saved["within"]["rounds_after"] == 1
    train_task.train(cfg, resume=True)
    assert started == [0]
    assert newtons[:2] == [0, 10]  # that of the second round is not made again
    assert newtons[2:] in (
        [15 + 7],
        [15 + 8],
    )  # what is left of its 10 steps, or by rounding one more
    assert len(steps) == 15 + 30 - 13
    assert torch.equal(steps[15], steps[14])  # the map goes on where it was
    assert load_checkpoint(cfg.out)[1]["within"] is None


def test_a_refit_leaves_materials_bit_for_bit(tmp_path, monkeypatch):
    data = write_scene(tmp_path / "data", views=8, size=24)
    light = SGConfig(lobes=4, hidden=16, directions=32, directions_eval=64)
    stage = StageConfig(voxels=0.01, iterations=30, share=0.4, rays=256, physical_from=0.5)
    stages = (
        stage,
        JointConfig(iterations=20, points=300, newton_points=100, rays=256, tracing=1),
        replace(stage, iterations=10, refit=True, physical_from=0.0),
    )
    sizes = SceneConfig(channels=4, material_channels=2, hidden=16, sky_nodes=32, light=light)
    run_stage, states = train_task.run_stage, []

    def watched(scene, *rest):
        states.append({k: v.clone() for k, v in scene.state_dict().items()})
        run_stage(scene, *rest)
        states.append({k: v.clone() for k, v in scene.state_dict().items()})

    monkeypatch.setattr(train_task, "run_stage", watched)
    train_task.train(TrainConfig(data, tmp_path / "run", stages, minutes=2.0, scene=sizes))
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
