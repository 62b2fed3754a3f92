"""The map that mirrors show: from a sphere under a map finer than its nodes."""

import math
from dataclasses import replace

import pytest
import torch
from analytic import RADIUS, photos_of, scene_of
from fine_map import fine_map, of_nodes
from observed_points import problem_on_a_sphere
from scipy.spatial import KDTree
from torch.nn.functional import normalize

from univoxel import sphere
from univoxel.color import linear_to_srgb_unclipped
from univoxel.config import JointConfig, MirrorConfig
from univoxel.envmap import EnvMap, lookup
from univoxel.lights.latlong import DistantLight
from univoxel.render.observations import Mirrors
from univoxel.training import envmap_from_mirrors, mirrors
from univoxel.training.mirrors import NEIGHBOURS, reflect

POINTS, VIEWS, NODES, ROWS = 1500, 16, 512, 64
BASE = torch.tensor([0.9, 0.7, 0.5])
CFG = JointConfig(mirror=MirrorConfig(rows=ROWS))


def fresnel(cosine):
    return BASE + (1 - BASE) * (1 - cosine) ** 5


def a_mirror(off=0.0, seed=0):
    """Scene, problem and true normals of a sphere that mirrors the fine map; the problem's normals
    are off by about so many degrees, alike among neighbours."""
    torch.manual_seed(seed)
    scene = scene_of((0.5, 0.5, 0.5), 0.5, NODES)
    problem = problem_on_a_sphere(POINTS, VIEWS, NODES, scene)
    with torch.no_grad():
        scene.sky.log_radiance.copy_(of_nodes(fine_map, scene.sky.direction).log())
    seen, normal = problem.observations, problem.observations.normal
    mirrored, cosine = reflect(normal, seen.wo.view(POINTS, VIEWS, 3))
    color = (fresnel(cosine[..., None]) * fine_map(mirrored)).flatten(0, 1)
    wave = math.radians(1.4 * off) * (5 * normal[:, [1, 2, 0]] + 1).sin()
    seen = replace(seen, color=color, normal=normalize(normal + wave, dim=1))
    return scene, replace(problem, observations=seen), normal


def views_of(problem):
    seen = problem.observations
    point = torch.arange(POINTS).repeat_interleave(VIEWS)
    return envmap_from_mirrors.MirrorViews.of(
        point, seen.wo, seen.color, BASE.expand(POINTS, 3), seen.normal
    )


def around(position, count=16):
    return torch.from_numpy(KDTree(position.numpy()).query(position.numpy(), k=count)[1])


def degrees(a, b):
    return torch.rad2deg((a * b).sum(1).clamp(-1, 1).acos())


def encoded_error(encoded):
    true = linear_to_srgb_unclipped(fine_map(sphere.latlong_directions(len(encoded))))
    return (encoded - true).abs().mean(2)


def test_what_is_seen_is_shared_among_four_texels_and_goes_around():
    direction = sphere.latlong_direction(torch.tensor([[0.0, 0.5], [0.25, 1e-4]]))
    sums = envmap_from_mirrors.splat(direction, torch.tensor([[1.0, 10.0], [2.0, 20.0]]), 8)
    assert torch.allclose(sums.sum((0, 1)), torch.tensor([3.0, 30.0]))
    # u = 0 lies between the last column and the first, v = 1/2 between two rows
    for row in (3, 4):
        for column in (0, 15):
            assert torch.allclose(sums[row, column], torch.tensor([0.25, 2.5]), atol=1e-4)
    assert torch.allclose(sums[0, 3:5].sum(0), torch.tensor([2.0, 20.0]), rtol=1e-2)
    assert torch.equal(envmap_from_mirrors.pooled(sums, 4).sum((0, 1)), sums.sum((0, 1)))


def test_a_mirror_shows_the_map_finer_than_nodes():
    _, problem, normal = a_mirror()
    found = envmap_from_mirrors.sharp_map(views_of(problem), normal, ROWS)
    nodes = DistantLight(NODES)
    with torch.no_grad():
        nodes.log_radiance.copy_(of_nodes(fine_map, nodes.direction).log())
        coarse = linear_to_srgb_unclipped(nodes.latlong(ROWS))
    seen = found.count > 1
    assert seen.float().mean() > 0.5
    assert encoded_error(found.encoded)[seen].mean() < 0.25 * encoded_error(coarse)[seen].mean()
    clipped = fine_map(sphere.latlong_directions(ROWS)).amax(2) > 1.2
    assert found.clipped[clipped & seen].mean() > 0.7
    assert found.clipped[~clipped & seen].mean() < 0.2


def test_where_nothing_is_mirrored_texels_are_as_those_around():
    _, problem, normal = a_mirror()
    views = views_of(problem)
    there = views.mirrored(normal)[:, 2] > 0
    found = envmap_from_mirrors.sharp_map(views.at(there), normal, ROWS)
    below = slice(ROWS * 3 // 4, None)
    assert not found.count[below].any()
    assert found.encoded[below].isfinite().all()
    inside = found.encoded[: ROWS // 2]
    assert inside.amin() <= found.encoded[below].amin()
    assert found.encoded[below].amax() <= inside.amax()


def test_map_and_normals_find_each_other(monkeypatch):
    _, problem, normal = a_mirror(off=4)
    off = problem.observations.normal
    assert 3 < degrees(off, normal).mean() < 6
    nearest = around(problem.observations.position)
    found = envmap_from_mirrors.agreed_normals(views_of(problem), off, nearest)
    assert torch.allclose(found.norm(dim=1), torch.ones(POINTS), atol=1e-5)
    assert degrees(found, normal).mean() < 0.6 * degrees(off, normal).mean()
    monkeypatch.setattr(envmap_from_mirrors, "TURNS", ())
    stay = envmap_from_mirrors.agreed_normals(views_of(problem), off, nearest)
    assert torch.equal(stay, off)


def test_what_is_far_off_counts_no_more_than_so_much():
    _, problem, normal = a_mirror()
    views = views_of(problem)
    black = torch.zeros(ROWS, 2 * ROWS, 3)
    assert envmap_from_mirrors.errors(black, views, normal).max() <= 0.3
    true = linear_to_srgb_unclipped(fine_map(sphere.latlong_directions(256)))
    assert envmap_from_mirrors.errors(true, views, normal).mean() < 0.01


def test_at_grazing_angles_metal_reflects_more():
    """What is seen over the reflectance, as linear radiance, is what was sent."""
    normal = torch.tensor([[0.0, 0.0, 1.0]])
    cosine = torch.tensor([1.0, 0.3])
    wo = torch.stack([(1 - cosine**2).sqrt(), torch.zeros(2), cosine], 1)
    point = torch.zeros(2, dtype=torch.int64)
    views = envmap_from_mirrors.MirrorViews.of(
        point, wo, 0.4 * fresnel(cosine[:, None]), BASE[None], normal
    )
    sent = linear_to_srgb_unclipped(torch.full((2, 3), 0.4))
    assert torch.allclose(views.incident, sent, rtol=1e-5)


def lit_by_a_lamp():
    """A sky, with a lamp that photographs clip, the nodes of it, and how mirrors show it."""
    direction = sphere.latlong_directions(ROWS)
    lamp = direction @ normalize(torch.tensor([1.0, 0.5, 0.7]), dim=0) > math.cos(0.2)
    true = torch.where(lamp[..., None], 30.0, 0.2 + 0.1 * direction[..., 2:]).expand(-1, -1, 3)

    def sky(toward):
        return lookup(EnvMap(true.contiguous()), toward)

    nodes = DistantLight(NODES)
    with torch.no_grad():
        nodes.log_radiance.copy_(of_nodes(sky, nodes.direction).log())
    views = sphere.fibonacci_sphere(60000)
    shown = sky(views).clamp_max(1.0)
    seen = envmap_from_mirrors.MirrorViews(
        torch.arange(len(views)), views, linear_to_srgb_unclipped(shown), shown[:, 0] > 0.97
    )
    return true, lamp, nodes, envmap_from_mirrors.sharp_map(seen, views, ROWS)


def irradiance(map):
    direction = sphere.latlong_directions(len(map)).flatten(0, 1)
    light = (map * sphere.texel_solid_angles(*map.shape[:2])[..., None]).flatten(0, 1)
    return (sphere.fibonacci_sphere(200) @ direction.T).clamp_min(0) @ light


def test_lamps_get_the_light_that_the_photographs_clip():
    true, lamp, nodes, shown = lit_by_a_lamp()
    assert (shown.clipped[lamp] > 0.5).float().mean() > 0.8
    found = envmap_from_mirrors.with_energy(shown, nodes)
    clipped = 0.2 + 0.1 * sphere.latlong_directions(ROWS)[..., 2:].expand(-1, -1, 3)
    clipped = torch.where(lamp[..., None], 1.0, clipped)
    wanted = irradiance(true)
    assert ((irradiance(clipped) / wanted - 1).abs()).max() > 0.5
    assert ((irradiance(found) / wanted - 1).abs()).max() < 0.05
    assert found[lamp].mean() > 15
    # What the lookup mixes with the lamp is bright too, for some texels around
    far = sphere.latlong_directions(ROWS) @ normalize(torch.tensor([1.0, 0.5, 0.7]), dim=0)
    far = far < math.cos(0.2 + 6 * math.pi / ROWS)
    assert (found[far] / true[far] - 1).abs().max() < 0.15
    nothing = replace(shown, count=0 * shown.count)
    assert torch.allclose(
        envmap_from_mirrors.with_energy(nothing, nodes), nodes.latlong(ROWS), rtol=0.02
    )


def test_a_map_of_less_light_and_brighter_paint_has_another_unit():
    true, lamp, nodes, shown = lit_by_a_lamp()
    with torch.no_grad():
        nodes.log_radiance += math.log(0.7)
    found = envmap_from_mirrors.with_energy(shown, nodes)
    assert ((irradiance(found) / irradiance(0.7 * true) - 1).abs()).max() < 0.05
    assert found[lamp].mean() > 0.7 * 15
    area = torch.full((NODES, 1), 4 * math.pi / NODES)
    sky = torch.rand(NODES, 3) * area
    place = sphere.fibonacci_sphere(NODES)
    unit = envmap_from_mirrors.unit_of(place, 0.7 * sky, sky, area, 0 * area)
    assert torch.allclose(unit, torch.full((3,), 0.7), rtol=1e-4)
    assert envmap_from_mirrors.unit_of(place, 0.7 * sky, sky, 0 * area, 0 * area) == 1.0
    assert envmap_from_mirrors.unit_of(place, 0.7 * sky, sky, area, area) == 1.0


@pytest.fixture
def sharpened(monkeypatch):
    """`sharpen_sky_` of a problem, on its own observations."""

    def run(scene, problem, sharp=None, cfg=CFG):
        everywhere = torch.ones(POINTS, dtype=torch.bool)
        sharp = everywhere if sharp is None else sharp
        found = Mirrors(
            everywhere, sharp, problem.observations.normal, BASE.expand(POINTS, 3).clone()
        )
        monkeypatch.setattr(
            mirrors, "points_beside", lambda *args: problem.observations.at(args[3])
        )
        return mirrors.sharpen_sky_(scene, photos_of(1, 8), problem, found, cfg)

    return run


def test_the_scene_keeps_the_map_that_its_mirrors_show(sharpened):
    scene, problem, _ = a_mirror(off=2)
    before = encoded_error(linear_to_srgb_unclipped(scene.sky.latlong(ROWS))).mean()
    assert sharpened(scene, problem)
    assert scene.cfg.sky_rows == ROWS
    after = encoded_error(linear_to_srgb_unclipped(scene.sky.latlong(ROWS))).mean()
    assert after < 0.6 * before


def test_a_map_that_the_nodes_tell_as_well_is_not_kept(sharpened):
    """Mirrors that show the nodes' own map, which half of the photographs tell less well."""
    scene, problem, normal = a_mirror()
    seen = problem.observations
    mirrored, cosine = reflect(normal, seen.wo.view(POINTS, VIEWS, 3))
    shown = scene.sky.incident(mirrored.flatten(0, 1)).detach()
    color = fresnel(cosine.flatten()[:, None]) * shown
    assert not sharpened(scene, replace(problem, observations=replace(seen, color=color)))
    assert scene.sky.sharp is None


def test_mirrors_that_contradict_one_another_show_no_map(sharpened):
    """Colours in another order: half of the photographs do not tell the other."""
    scene, problem, _ = a_mirror()
    mixed = torch.randperm(POINTS * VIEWS)
    seen = replace(problem.observations, color=problem.observations.color[mixed])
    assert not sharpened(scene, replace(problem, observations=seen))
    assert scene.cfg.sky_rows == 0
    assert scene.sky.sharp is None


@pytest.mark.parametrize("one", [0, 1])
def test_few_points_or_one_photograph_show_no_map(sharpened, one):
    scene, problem, _ = a_mirror()
    few = torch.arange(POINTS) < NEIGHBOURS - 1
    assert not sharpened(scene, problem, few)
    seen = replace(problem.observations, view=0 * problem.observations.view + one)
    assert not sharpened(scene, replace(problem, observations=seen))
    shut = replace(problem.transport, visibility=torch.zeros_like(problem.transport.visibility))
    assert not sharpened(scene, replace(problem, transport=shut))
    none = replace(CFG, mirror=MirrorConfig(rows=0))
    assert not sharpened(scene, problem, cfg=none)


def test_points_beside_lie_on_the_surface():
    scene, problem, _ = a_mirror()
    photos = photos_of(4, 32)
    parent = torch.arange(40).repeat(3)
    found = mirrors.points_beside(scene, photos, problem, parent)
    assert len(found.position) == 120
    assert (found.position.norm(dim=1) - RADIUS).abs().max() < 0.2 * problem.voxel_size
    moved = (found.position - problem.observations.position[parent]).norm(dim=1)
    assert 0.3 * problem.voxel_size < moved.mean() < 3 * problem.voxel_size
    assert degrees(found.normal, normalize(found.position, dim=1)).max() < 5
