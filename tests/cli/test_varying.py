"""Photographs in varying light: what differs is found, and materials stay as under one light."""

import math
from dataclasses import replace

import pytest
import torch
from analytic import scene_of, sphere_scene, write_scene
from observed_points import (
    BLUE,
    RED,
    Steps,
    in_double,
    lamps,
    no_metal,
    photographed,
    photographs_under,
    problem_on_a_sphere,
    random_problem,
)
from plain import plain_stage, plain_training, small_scene
from tiny import OPTIONS

from univoxel.cli import main
from univoxel.cli import trainer as task
from univoxel.cli.trainer import train
from univoxel.color import linear_to_srgb_unclipped
from univoxel.config import JointConfig
from univoxel.data import load_photos
from univoxel.data.images import read_image
from univoxel.preparation import prepare
from univoxel.render.observations import prefiltered_roughness, shade_observations
from univoxel.render.pipeline import extract_mesh
from univoxel.scene import Scene, load_checkpoint, load_scene, save_scene
from univoxel.training import equations, joint_solve, newton
from univoxel.training.loop import held_out_psnr
from univoxel.training.newton import newton_round_

NODES = 12


def varying(scene: Scene, views: int, kind: str = "light") -> Scene:
    """The same scene for photographs that differ, with something of their own in each."""
    torch.manual_seed(4)
    names = tuple(f"r_{v}" for v in range(views))
    other = Scene(replace(scene.cfg, varying=kind, views=names), scene.field)
    other.material = scene.material
    with torch.no_grad():
        other.views.gain_steps.normal_(0, 0.03)
        if kind == "light":
            other.views.sky_weights.normal_()
    return other


def test_observations_are_shaded_in_the_light_of_their_photographs():
    problem, albedo, roughness = random_problem(), torch.rand(5, 3), 0.2 + 0.6 * torch.rand(5)
    scene = varying(sphere_scene(NODES), 4)
    problem = replace(problem, sky=scene.sky)
    f0, views = torch.full((20, 3), 0.04), scene.views
    point = torch.repeat_interleave(problem.observations.offsets.diff())
    order = torch.randperm(20)
    with torch.no_grad():
        shaded = torch.empty(20, 3)
        shaded[order] = shade_observations(
            *(scene, problem, point[order], order, problem.observations.normal[point][order]),
            *(albedo[point][order], roughness[point][order], f0),
        )
        for v in range(4):
            map = (scene.sky.log_radiance + views.sky_change()[v]).exp()
            alone = photographed(problem, map, albedo, roughness).observations.color * views.gain(v)
            torch.testing.assert_close(shaded[v::4], alone[v::4])


def test_equations_know_what_differs():
    """Gradient of the cost under gains and changes of the map, against autograd; in double."""
    problem = random_problem()
    map, albedo = 0.5 + torch.rand(NODES, 3), 0.2 + 0.6 * torch.rand(5, 3)
    problem = photographed(problem, map, albedo, torch.full((5,), 0.3))
    point, observation = torch.arange(5), torch.arange(20).view(5, 4)
    rough = torch.full((5,), 0.3)
    transport = newton.linear_transport(problem, point, observation, rough, False)
    assert torch.equal(transport.view, observation % 4)
    transport = in_double(transport)
    differences = equations.view_differences(varying(sphere_scene(NODES), 4))
    gain = differences.gain.detach().double()
    change = differences.map_factor.detach().double()
    basis = differences.basis.detach().double()
    start = (map.log(), albedo.log(), gain.log(), torch.zeros(4, len(basis), 3))
    x, a, g, w = (value.double().requires_grad_() for value in start)
    more = torch.einsum("vrc,rd->vdc", w, basis)
    light = x.exp() * (change * more.exp())[transport.view]  # [P, V, D, 3]
    diffuse = torch.einsum("pxd,pvdc->pvc", transport.diffuse, light)
    diffuse = diffuse * transport.diffuse_factor[..., None] + transport.diffuse_indirect
    specular = torch.einsum("pvd,pvdc->pvc", transport.specular, light)
    shaded = a.exp()[:, None] * diffuse + specular + transport.specular_indirect
    residual = transport.target - linear_to_srgb_unclipped(g.exp()[transport.view] * shaded)
    cauchy = newton.CAUCHY
    weight = 1 / (1 + (residual.detach() / cauchy) ** 2)
    weight = weight.masked_fill((transport.target > equations.CLIPPED) & (residual < 0), 0.0)
    cost = (weight * residual.square()).sum()
    by_map, by_albedo, by_gain, by_weights = torch.autograd.grad(cost, (x, a, g, w))
    state = transport, map.double(), a.detach(), cauchy
    differences = equations.ViewDifferences(gain, change, basis)
    _, right, back = equations.normal_equations(*state, differences)
    assert back.cost == pytest.approx(cost.item(), rel=1e-6)
    # The elimination's share of the gradient put back
    full = right + torch.einsum("cpd,cp->cd", back.cross, back.gradient / back.curvature)
    exact = {"rtol": 1e-5, "atol": 1e-7}
    torch.testing.assert_close(full[:, :NODES], -by_map.T / 2, **exact)
    torch.testing.assert_close(full[:, NODES:], -by_gain.T / 2, **exact)
    torch.testing.assert_close(back.gradient, -by_albedo.T / 2, **exact)
    _, slopes = equations.view_equations(*state, differences)
    torch.testing.assert_close(slopes[..., -1], -by_gain.T / 2, **exact)
    torch.testing.assert_close(slopes[..., :-1], -by_weights.permute(2, 0, 1) / 2, **exact)


def stops(views: int, most: float) -> torch.Tensor:
    """Random gains [V, 3] in stops, of mean 0."""
    torch.manual_seed(0)
    random = most * (2 * torch.rand(views, 3) - 1)
    return random - random.mean(0)


def test_newton_finds_gains_and_what_each_map_has_of_its_own():
    nodes, views = 64, 12
    scene = varying(scene_of((0.5, 0.4, 0.3), 0.3, nodes), views)
    problem = problem_on_a_sphere(400, views, nodes, scene)
    map = (0.6 * torch.randn(nodes, 3)).exp() * 0.6
    wanted = stops(views, 1.0)
    change = scene.views.sky_change().detach()
    colors = [
        photographed(
            problem,
            map * change[v].exp() * 2 ** wanted[v],
            torch.tensor([0.5, 0.4, 0.3]).expand(400, 3),
            prefiltered_roughness(torch.full((400,), 0.3), nodes),
        ).observations.color[v::views]
        for v in range(views)
    ]
    color = torch.stack(colors, 1).flatten(0, 1)
    problem = replace(problem, target=linear_to_srgb_unclipped(color))
    with torch.no_grad():
        scene.views.gain_steps.zero_()
        scene.views.sky_weights.zero_()
    cfg = JointConfig(newton_points=400, newton_views=12, newton_steps=8)
    costs = newton_round_(scene, problem, no_metal(problem), cfg).costs
    costs += newton_round_(scene, problem, no_metal(problem), cfg).costs
    assert costs[-1] < 0.03 * costs[0]
    # A view sees half a sphere of normals, on which a change of degree 2 or 3 is nearly a gain and
    # one of degree 1: between them part stays open, though what they draw together does not
    off = scene.views.sky_change() - change
    assert off.square().mean().sqrt() < 0.4 * change.square().mean().sqrt()
    assert (scene.views.log_gain / math.log(2) - wanted).abs().max() < 0.5


def test_solve_finds_gains_and_the_albedo_under_them():
    nodes, views = 128, 16
    wanted = stops(views, 1.0)
    photos = photographs_under(2 ** wanted[:, None] * lamps(nodes), 0.29)
    scene = varying(sphere_scene(nodes), views, "exposure")
    with torch.no_grad():
        scene.views.gain_steps.zero_()
    cfg = JointConfig(points=800, newton_points=800, rays=512, tracing=1, rounds=3)
    joint_solve.solve(scene, photos, cfg, 0, Steps(400))
    error = scene.views.log_gain.detach() / math.log(2) - wanted
    mesh = extract_mesh(scene)
    x = mesh.vertices[:, 0]
    ratio = torch.stack([mesh.albedo[x > 0.1].mean(0) / RED, mesh.albedo[x < -0.1].mean(0) / BLUE])
    assert error.square().mean().sqrt() < 0.1  # of gains that differ by 0.6
    assert error.abs().max() < 0.3
    # A factor per channel is the light's too; between the sides it is none
    assert (ratio[0] / ratio[1] - 1).abs().max() < 0.2


def test_training_explains_exposures(tmp_path):
    data = write_scene(tmp_path / "data", gain=2 ** stops(12, 1.5))
    stages = (
        plain_stage(voxels=0.01, iterations=40, share=0.5, rays=256),
        plain_stage(voxels=0.03, iterations=60, share=0.5, rays=256, physical_from=0.0),
    )
    photos = load_photos(data, "train")
    pixels = torch.cartesian_prod(torch.arange(12), torch.arange(32), torch.arange(32))
    found = {}
    for varying in ("none", "exposure", "light"):
        scene, run = small_scene(varying=varying), tmp_path / varying
        learned = load_scene(train(plain_training(data, run, stages, minutes=2.0, scene=scene)))
        assert learned.cfg.varying == varying
        assert learned.cfg.views == (() if varying == "none" else tuple(photos.names))
        found[varying] = held_out_psnr(learned, photos, pixels, physical=True)
    assert min(v for k, v in found.items() if k != "none") > found["none"] + 1


def test_training_starts_from_the_exposures_that_were_seen(tmp_path, monkeypatch):
    wanted = stops(12, 1.5).mean(1, keepdim=True).expand(-1, 3)
    data = write_scene(tmp_path / "data", gain=2**wanted)
    monkeypatch.setattr(task, "run_stage", lambda *_: None)
    stages = (plain_stage(voxels=0.01, iterations=1, share=1.0),)
    cfg = plain_training(data, tmp_path / "run", stages, minutes=1.0, exposures=True)
    learned = load_scene(train(cfg))
    assert learned.cfg.varying == "exposure"
    found = learned.views.log_gain.detach() / math.log(2)
    assert (found - wanted).square().mean().sqrt() < 0.1


@pytest.mark.parametrize(
    ("saved", "changes", "varying"),
    [
        (1.01, {}, "light"),
        (0.99, {}, "none"),
        (9.0, {"exposures": False}, "none"),
        (9.0, {"light_frame": "camera"}, "none"),
    ],
)
def test_light_that_differs_is_learned(tmp_path, monkeypatch, saved, changes, varying):
    monkeypatch.setattr(prepare, "varied_light", lambda *_: saved * prepare.VARIED)
    monkeypatch.setattr(task, "run_stage", lambda *_: None)
    stages = (plain_stage(voxels=0.01, iterations=1, share=1.0),)
    changes = {"exposures": True} | changes
    cfg = plain_training(write_scene(tmp_path / "data"), tmp_path / "run", stages, **changes)
    assert load_scene(train(cfg)).cfg.varying == varying


def test_the_light_of_a_view_from_the_command_line(tmp_path, capsys):
    data = write_scene(tmp_path / "data", views=6, size=16)
    run = tmp_path / "run"
    assert main(["train", str(data), "--out", str(run), "--varying", "light", *OPTIONS]) == 0
    with torch.no_grad():  # 20 steps make no difference to see
        scene, state = load_checkpoint(run)
        scene.views.sky_weights.normal_()
        scene.views.gain_steps.normal_(0, 0.1)
        save_scene(scene, run, state)
    maps = {}
    for view in (None, "r_2", "2", "3"):
        out = tmp_path / f"{view}.exr"
        options = [] if view is None else ["--light-of", view]
        assert main(["envmap", str(run), "--out", str(out), "--height", "8", *options]) == 0
        maps[view] = read_image(out)
    assert torch.equal(maps["r_2"], maps["2"])
    assert not torch.allclose(maps["2"], maps["3"], rtol=0.1)
    assert not torch.allclose(maps["2"], maps[None], rtol=0.1)
    place = ["--view", "0", "--pixel", "8,8"]
    for command in (["eval"], ["inspect", *place]):
        assert main([command[0], str(run), *command[1:], "--light-of", "r_2"]) == 0
    said = "--light-of: expected the number of a view (below 6) or its name (from r_0 to r_5)"
    for command in (["eval"], ["inspect", *place], ["envmap", "--out", str(tmp_path / "a.exr")]):
        capsys.readouterr()
        assert main([command[0], str(run), *command[1:], "--light-of", "r_9"]) == 2
        assert said in capsys.readouterr().err
