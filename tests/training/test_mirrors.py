"""Metals that mirror: found on a sphere under a map finer than its nodes, with normals that are
off."""

import math
from dataclasses import replace
from unittest.mock import Mock

import pytest
import torch
from analytic import scene_of
from observed_points import photographed, problem_on_a_sphere
from torch.nn.functional import normalize

from univoxel import sphere
from univoxel.color import linear_to_srgb_unclipped
from univoxel.config import JointConfig
from univoxel.lights.views import Turntable
from univoxel.render.observations import Mirrors
from univoxel.training import joint_solve, mirrors


def fine_map(direction):
    """Radiance [..., 3] from directions [..., 3], and lamps."""
    x, y, z = direction.unbind(-1)
    pattern = 0.4 * (1.2 * (7 * x).sin() * (6 * y + 1).sin() + 1.2 * (7 * z + 2).sin()).exp()
    tint = torch.stack([0.5 + 0.2 * x, 0.5 + 0.2 * y, 0.5 - 0.2 * z], -1)
    return pattern[..., None] * tint


def of_nodes(map, direction):
    """Means [D, 3] of a map around nodes [D, 3]."""
    nodes = torch.zeros(len(direction), 3)
    texels = sphere.latlong_directions(64).flatten(0, 1)
    nearest = (texels @ direction.T).argmax(1)
    area = sphere.texel_solid_angles(64, 128).reshape(-1, 1)
    nodes.index_add_(0, nearest, map(texels) * area)
    return nodes / torch.zeros(len(direction), 1).index_add(0, nearest, area)


POINTS, VIEWS, NODES = 1500, 16, 512
BASE = torch.tensor([0.9, 0.7, 0.5])


def under_fine_map(metal, paint, off=0.0):
    """A scene with the map's nodes, and photographs of a sphere: mirrors where `metal` of the
    normals [P, 3] says so, else what `paint` makes; normals are off by degrees."""
    torch.manual_seed(0)
    scene = scene_of((0.5, 0.5, 0.5), 0.5, NODES)
    problem = problem_on_a_sphere(POINTS, VIEWS, NODES, scene)
    nodes = of_nodes(fine_map, scene.sky.direction)
    with torch.no_grad():
        scene.sky.log_radiance.copy_(nodes.log())
    normal = problem.observations.normal
    painted = photographed(problem, nodes, *paint(normal)).observations.color
    wo = problem.observations.wo.view(POINTS, VIEWS, 3)
    mirrored = BASE * fine_map(mirrors.reflect(normal, wo)[0]).flatten(0, 1)
    is_metal = metal(normal)
    color = torch.where(is_metal.repeat_interleave(VIEWS)[:, None], mirrored, painted)
    wave = math.radians(1.4 * off) * (3 * normal[:, [1, 2, 0]] + 1).sin()
    seen = replace(problem.observations, color=color, normal=normalize(normal + wave, dim=1))
    return scene, replace(problem, observations=seen, target=linear_to_srgb_unclipped(color))


def white(normal):
    return torch.full((POINTS, 3), 0.6), torch.full((POINTS,), 0.9)


def black_and_glossy(normal):
    return torch.full((POINTS, 3), 0.02), torch.full((POINTS,), 0.3)


def degrees(a, b):
    return torch.rad2deg((a * b).sum(1).clamp(-1, 1).acos())


@pytest.mark.parametrize("paint", [white, black_and_glossy])
def test_a_mirror_is_found_though_its_normals_are_off(paint):
    scene, problem = under_fine_map(lambda n: n[:, 2] > 0, paint, off=10)
    found = mirrors.find_mirrors(scene, problem)
    true_normal = normalize(problem.observations.position, dim=1)
    above, below = true_normal[:, 2] > 0.25, true_normal[:, 2] < -0.25
    assert found.metal[above].float().mean() > 0.95
    assert found.metal[below].float().mean() < 0.02
    sharp = above & found.sharp
    assert sharp.sum() > 0.85 * above.sum()
    assert degrees(problem.observations.normal, true_normal)[sharp].mean() > 4
    assert not found.base[~found.metal].any()


@pytest.mark.parametrize("paint", [white, black_and_glossy])
def test_where_nothing_mirrors_nothing_changes(paint):
    scene, problem = under_fine_map(lambda n: n[:, 2] > 2, paint)
    torch.manual_seed(3)
    expected = torch.rand(4)
    torch.manual_seed(3)
    assert mirrors.find_mirrors(scene, problem) is None
    assert torch.equal(torch.rand(4), expected)


def test_how_much_a_point_changes_tells_and_not_what_it_mirrors():
    """Colours of mirrors, given to the points in another order."""
    scene, problem = under_fine_map(lambda n: n[:, 2] > -2, white)
    mixed = torch.randperm(POINTS * VIEWS)
    seen = replace(problem.observations, color=problem.observations.color[mixed])
    found = mirrors.find_mirrors(scene, replace(problem, observations=seen))
    assert found.metal.float().mean() > 0.97
    assert found.sharp.float().mean() > 0.97


def test_what_changes_too_little_is_paint(monkeypatch):
    """However little the map changes, for 8 bits are noisy; and lacquer changes less than what it
    mirrors."""
    scene, problem = under_fine_map(lambda n: n[:, 2] > -2, white)
    with monkeypatch.context() as patch:
        patch.setattr(mirrors, "CHANGE", 0.5)
        assert mirrors.find_mirrors(scene, problem) is None
    lacquer = 0.3 + 0.35 * problem.observations.color
    problem = replace(problem, observations=replace(problem.observations, color=lacquer))
    assert mirrors.find_mirrors(scene, problem) is None
    monkeypatch.setattr(mirrors, "REFLECTED", 0.2)
    assert mirrors.find_mirrors(scene, problem).metal.float().mean() > 0.9


def test_what_changes_more_than_all_that_it_could_mirror_is_no_mirror(monkeypatch):
    """As paint under a sun does, beside which the map is dark; here the map is too dark."""
    scene, problem = under_fine_map(lambda n: n[:, 2] > -2, white)
    assert mirrors.find_mirrors(scene, problem).metal.float().mean() > 0.9
    with torch.no_grad():
        scene.sky.log_radiance -= math.log(3)
    assert mirrors.find_mirrors(scene, problem) is None
    monkeypatch.setattr(mirrors, "REFLECTED_AT_MOST", 9.0)
    assert mirrors.find_mirrors(scene, problem).metal.float().mean() > 0.9


def test_points_that_see_no_sky_are_as_their_neighbours():
    scene, problem = under_fine_map(lambda n: n[:, 2] > 0, white)
    true_normal = normalize(problem.observations.position, dim=1)
    visibility = problem.transport.visibility.clone()
    blocked = (true_normal[:, 2] > 0.3) & (torch.arange(POINTS) % 2 == 0)
    visibility[blocked] = 0
    problem = replace(problem, transport=replace(problem.transport, visibility=visibility))
    found = mirrors.find_mirrors(scene, problem)
    assert found.metal[blocked].float().mean() > 0.95


def test_fewer_than_half_of_the_voters_are_not_asked(monkeypatch):
    """Nor what is near them looked for, which takes most of the time where nothing mirrors."""
    scene, problem = under_fine_map(lambda n: n[:, 2] > 2, white)
    neighbours = Mock(wraps=mirrors.neighbours)
    monkeypatch.setattr(mirrors, "neighbours", neighbours)
    assert mirrors.find_mirrors(scene, problem) is None
    assert [call.args[1] for call in neighbours.call_args_list] == [mirrors.NEIGHBOURS]

    def some(count):
        def found(seen, *_):
            metal = torch.arange(len(seen.key)) < count
            return Mirrors(metal, metal, seen.normal, 0.5 * torch.ones_like(seen.normal))

        return found

    monkeypatch.setattr(mirrors, "VOTERS", 10)
    for count, voted in ((5, False), (6, True)):
        neighbours.reset_mock()
        monkeypatch.setattr(mirrors, "mirrors_among", some(count))
        mirrors.find_mirrors(scene, problem)
        assert (10 in [call.args[1] for call in neighbours.call_args_list]) == voted


def test_light_that_turns_and_too_few_points_say_nothing(monkeypatch):
    scene, problem = under_fine_map(lambda n: n[:, 2] > 0, white)
    assert mirrors.find_mirrors(scene, replace(problem, turned=Turntable)) is None
    monkeypatch.setattr(mirrors, "NEIGHBOURS", POINTS + 1)
    assert mirrors.find_mirrors(scene, problem) is None


def test_base_colours_are_read_from_where_it_is_dark():
    """A lamp, which the photographs clip, lights half of the sky."""
    scene, problem = under_fine_map(lambda n: n[:, 2] > 0, white)
    seen, direction = problem.observations, scene.sky.direction
    dark = 0.3 + 0.2 * direction
    with torch.no_grad():
        scene.sky.log_radiance.copy_(torch.where(direction[:, :1] > 0, 8.0, dark).log())
    point = torch.arange(POINTS).repeat_interleave(VIEWS)
    wo = seen.wo
    mirrored = mirrors.reflect(seen.normal[point], wo[:, None])[0][:, 0]
    shown = BASE * torch.where(mirrored[:, :1] > 0, 8.0, 0.3 + 0.2 * mirrored)
    problem = replace(problem, observations=replace(seen, color=shown.clamp_max(1.0)))
    found = mirrors.find_mirrors(scene, problem)
    assert found.metal.float().mean() > 0.5  # points that mirror one side alone do not tell
    base = found.base[found.metal].median(0).values
    assert (base / BASE - 1).abs().max() < 0.03


def test_polished_surfaces_have_no_relief():
    torch.manual_seed(0)
    normal = normalize(torch.randn(2000, 3), dim=1)
    bumpy = normalize(normal + 0.15 * torch.randn(2000, 3), dim=1)
    ball = 0.5 * normal
    everywhere = torch.ones(2000, dtype=torch.bool)
    sharp, smooth = mirrors.smoothed(ball, bumpy, everywhere)
    before, after = (degrees(n, normal).mean() for n in (bumpy, smooth))
    assert after < 0.4 * before
    assert sharp.all()
    half = everywhere & (normal[:, 2] > 0)
    sharp, smooth = mirrors.smoothed(ball, bumpy, half)
    assert torch.equal(smooth[~half], bumpy[~half])
    assert torch.equal(sharp, half)
    few = torch.arange(2000) < mirrors.NEIGHBOURS - 1
    sharp, smooth = mirrors.smoothed(ball, bumpy, few)
    assert torch.equal(smooth, bumpy)
    assert torch.equal(sharp, few)


def test_thin_surfaces_keep_their_normals_and_are_not_called_sharp():
    """Their normals are off by so much that the map explains little of what is mirrored, however
    rough they are."""
    torch.manual_seed(0)
    around = normalize(torch.randn(2000, 3) * torch.tensor([1.0, 1.0, 0.0]), dim=1)
    wire = 0.005 * around + torch.linspace(-0.5, 0.5, 2000)[:, None] * torch.tensor([0.0, 0, 1])
    everywhere = torch.ones(2000, dtype=torch.bool)
    sharp, normal = mirrors.smoothed(wire, around, everywhere)
    assert torch.equal(normal, around)
    assert not sharp.any()


def test_a_mirror_is_as_bright_where_it_mirrors_nothing_dark():
    """Two polished metals of two colours each, in parts that show a half more or less, under a map
    that is grey everywhere."""
    direction = sphere.fibonacci_sphere(NODES)
    grey = torch.full((mirrors.ROWS, 2 * mirrors.ROWS, 3), 0.5)
    map = mirrors.NodeMap.of(direction, grey, torch.full((NODES, 3), 0.5))
    normal = torch.tensor([[0.0, 0.0, 1.0]]).repeat(8, 1)
    wo = torch.tensor([0.0, 0.0, 1.0]).expand(8, 4, 3)
    part = torch.tensor([0.4, 0.4, 0.8, 0.8, 0.3, 0.3, 0.5, 0.5])
    red, golden = torch.tensor([1.0, 0.2, 0.2]), torch.tensor([1.0, 0.8, 0.4])
    color = part[:, None] * torch.where(torch.arange(8)[:, None] % 4 < 2, golden, red)
    is_open = torch.ones(8, 4, dtype=torch.bool)
    shown = (0.5 * color)[:, None].expand(8, 4, 3)
    seen = mirrors.MirrorObservations(torch.zeros(8, 6), normal, wo, shown, is_open)
    everywhere = torch.ones(8, dtype=torch.bool)
    # Each pair is of one colour; a link leads from the first pair of a metal to the second
    nearest = torch.tensor([[0, 1], [1, 0], [2, 3], [3, 2], [4, 5], [5, 4], [6, 7], [7, 6]])
    apart = mirrors.reflectance(seen, map, everywhere, everywhere, nearest)
    assert torch.allclose(apart, color, rtol=1e-4)
    linked = nearest.clone()
    linked[1], linked[5] = torch.tensor([1, 2]), torch.tensor([5, 6])
    base = mirrors.reflectance(seen, map, everywhere, everywhere, linked)
    assert torch.allclose(base.amax(1), torch.tensor([0.6] * 4 + [0.4] * 4), rtol=1e-4)
    own = color / color.amax(1, keepdim=True)
    alone = torch.tensor([0, 2, 3, 4, 6, 7])  # whose neighbours are all of their colour
    assert torch.allclose((base / base.amax(1, keepdim=True))[alone], own[alone], rtol=1e-4)
    rough = torch.zeros(8, dtype=torch.bool)
    as_seen = mirrors.reflectance(seen, map, everywhere, rough, nearest)
    assert torch.allclose(as_seen, color, rtol=1e-4)


def test_what_is_rough_mirrors_but_is_not_sharp():
    """Metal that blurs the map as its nodes do is explained with the normals that it has."""
    scene, problem = under_fine_map(lambda n: n[:, 2] > 2, white)
    metal = torch.zeros(POINTS, 3), torch.full((POINTS,), 0.25), BASE.expand(POINTS, 3)
    problem = photographed(problem, scene.sky.radiance.detach(), *metal)
    found = mirrors.find_mirrors(scene, problem)
    assert found.metal.float().mean() > 0.95
    assert not found.sharp.any()


def test_sharp_points_learn_what_was_found_of_them():
    normal = normalize(torch.randn(3, 3), dim=1)
    base = torch.full((3, 3), 0.8)
    sharp = torch.tensor([True, True, False])
    found = Mirrors(torch.ones(3, dtype=torch.bool), sharp, normal, base)
    point = torch.arange(3)
    smooth = torch.full((3,), 0.05)
    there = joint_solve.mirror_loss(found, point, normal, base, smooth)
    assert there == 0
    elsewhere = -normal, 0.5 * base, smooth + 0.3
    # of two thirds of the points
    expected = 2 / 3 * (2 + math.log(2) + 0.3)
    away = joint_solve.mirror_loss(found, point, *elsewhere).item()
    assert away == pytest.approx(expected, rel=1e-5)


def test_the_map_of_nodes_teaches_sharp_points_nothing():
    scene, problem = under_fine_map(lambda n: n[:, 2] > 0, white)
    everything = torch.ones(POINTS, dtype=torch.bool)
    found = Mirrors(everything, everything, problem.observations.normal, BASE.expand(POINTS, 3))
    decisions = joint_solve.MaterialLabels(everything, mirrors=found)
    terms = joint_solve.objective(scene, problem, decisions, JointConfig(rays=64))
    assert terms["joint"] == 0
    assert terms["mirrors"] > 0
    none = joint_solve.objective(
        scene, problem, joint_solve.MaterialLabels(everything), JointConfig(rays=64)
    )
    assert none["joint"] > 0
    assert "mirrors" not in none
