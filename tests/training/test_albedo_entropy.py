"""Paint comes in few colours: a sun is seen in its shadows, a sky in its shades."""

import math
import re
from dataclasses import replace

import pytest
import torch
from analytic import scene_of
from observed_points import lamps, no_metal, photographed, problem_on_a_sphere
from torch.nn.functional import normalize

from univoxel.config import JointConfig
from univoxel.lights.views import ViewLights
from univoxel.render.observations import prefiltered_roughness
from univoxel.training import albedo_entropy
from univoxel.training.newton import newton_round_

NODES, POINTS = 128, 900
PAINTS = torch.tensor([[0.7, 0.2, 0.1], [0.1, 0.3, 0.6], [0.5, 0.5, 0.4], [0.05, 0.06, 0.05]])
SUN = normalize(torch.tensor([0.4, -0.3, 0.8]), dim=0)


def painted(light, views=4, shiny=False):
    """A scene that knows no map yet, and a sphere behind random walls, of matte paints or of paints
    under a layer as rough as the scene believes, under a map [D, 3]; and the albedo [P, 3]."""
    torch.manual_seed(3)
    scene = scene_of((0.5, 0.5, 0.5), 0.5, NODES)
    problem = problem_on_a_sphere(POINTS, views, NODES, scene)
    direction = problem.transport.direction
    wall = normalize(torch.randn(POINTS, 3), dim=1) @ direction.T > 0.3
    visibility = (~wall * 255).byte()
    transport = replace(problem.transport, visibility=visibility)
    problem = replace(problem, transport=transport)
    albedo = PAINTS[torch.randint(len(PAINTS), (POINTS,))]
    if shiny:
        rough = prefiltered_roughness(torch.full((POINTS,), 0.5), NODES)
        return scene, photographed(problem, light, albedo, rough), albedo
    cosine = (
        (problem.observations.normal @ direction.T).clamp_min(0) * problem.solid_angle / math.pi
    )
    color = (albedo * ((cosine * ~wall) @ light)).repeat_interleave(views, 0)
    return scene, in_colors(problem, color), albedo


def in_colors(problem, color):
    """The same problem with other observations [S, 3]."""
    return replace(problem, observations=replace(problem.observations, color=color))


def believed(scene, problem):
    """Albedo [P, 3] under the scene's map of matte paints, and which points."""
    points = albedo_entropy.painted_points(scene, problem, no_metal(problem))
    return points.color / points.irradiance(scene.sky.radiance.detach()), points.point


def with_sun(share):
    """An even sky and, near SUN, a node that sends such a share of all light."""
    direction = problem_on_a_sphere(1, 1, NODES).transport.direction
    node = int((direction @ SUN).argmax())
    map = torch.full((NODES, 3), 1 - share) * torch.tensor([0.8, 0.9, 1.1])
    map[node] += share * NODES
    return map, node


@pytest.mark.parametrize("share", [0.5, 0.8, 0.95])
def test_a_sun_is_found(share):
    map, node = with_sun(share)
    scene, problem, albedo = painted(map)
    sun = albedo_entropy.fit_sun_(scene, problem, no_metal(problem))
    assert sun is not None
    assert str(sun).endswith(f"gives {share:.0%} of the light")
    azimuth, elevation = (math.radians(int(x)) for x in re.findall(r"-?\d+", str(sun))[:2])
    across = math.cos(elevation)
    told = across * math.cos(azimuth), across * math.sin(azimuth), math.sin(elevation)
    assert torch.tensor(told) @ problem.transport.direction[node] > math.cos(math.radians(1))
    assert (sun.log_excess.amin(1) > 0).nonzero().flatten().tolist() == [node]
    power = scene.sky.radiance.detach().mean(1)
    # Shares are tried in steps of 0.05 to 0.15; walls make them differ by a little
    assert float(power[node] / power.sum()) == pytest.approx(share, abs=0.1)
    under_sun, point = believed(scene, problem)
    error = (under_sun / albedo[point]).log()
    shadows = (problem.observations.color.view(POINTS, -1, 3)[point, 0] / albedo[point]).log()
    spread = (error - error.median(0).values).abs().mean()
    assert spread < 0.2 * (shadows - shadows.median(0).values).abs().mean()


def test_smoothness_leaves_the_sun():
    """Newton's equations, which diffuse points tell nothing, would take it down."""
    map, node = with_sun(0.8)
    scene, problem, _ = painted(map)
    sun = albedo_entropy.fit_sun_(scene, problem, no_metal(problem))
    before = scene.sky.log_radiance.detach()[node] - scene.sky.log_radiance.detach().mean(0)
    dark = replace(problem, target=torch.zeros_like(problem.target))
    cfg = JointConfig(newton_points=300, newton_steps=2, newton_views=4, newton_smooth=1e3)
    newton_round_(scene, dark, replace(no_metal(dark), sun=sun.log_excess), cfg)
    after = scene.sky.log_radiance.detach()[node] - scene.sky.log_radiance.detach().mean(0)
    torch.testing.assert_close(after, before, atol=0.1, rtol=0)


@pytest.mark.parametrize("light", ["even", "lamps", "known"])
def test_where_there_is_none_the_map_stays(light):
    map = {"even": torch.ones(NODES, 3), "lamps": lamps(NODES), "known": with_sun(0.8)[0]}[light]
    scene, problem, _ = painted(map)
    if light == "known":
        scene.sky.log_radiance.data.copy_(map.log())
    before = scene.sky.log_radiance.detach().clone()
    assert albedo_entropy.fit_sun_(scene, problem, no_metal(problem)) is None
    assert torch.equal(scene.sky.log_radiance, before)


@pytest.mark.parametrize(
    "why", ["few points", "few observations", "metal", "mostly metal", "dark", "light varies"]
)
def test_what_tells_nothing_is_not_asked(why):
    scene, problem, _ = painted(with_sun(0.8)[0], views=2 if why == "few observations" else 4)
    decisions = no_metal(problem)
    if why == "few points":
        lit = (torch.arange(POINTS) < 299).repeat_interleave(4)[:, None]
        problem = in_colors(problem, problem.observations.color * lit)
    elif why == "mostly metal":
        decisions = replace(decisions, metal=torch.arange(POINTS) >= 400)
    elif why == "metal":
        decisions = replace(decisions, metal=~decisions.metal)
    elif why == "dark":
        problem = in_colors(problem, problem.observations.color * 1e-3)
    elif why == "light varies":
        scene.views = ViewLights(("a", "b", "c", "d"), 2, scene.sky.direction)
    before = scene.sky.log_radiance.detach().clone()
    assert albedo_entropy.fit_sun_(scene, problem, decisions) is None
    assert not albedo_entropy.minimise_entropy_(scene, problem, decisions)
    assert torch.equal(scene.sky.log_radiance, before)


def known(scene, map):
    scene.sky.log_radiance.data.copy_(map.log())


def tilt(scene, problem, map, change):
    """How uneven the scene's map is over another, in log; and the mean log light on the points."""
    known(scene, map * change.exp())
    begin = believed(scene, problem)[0].log().mean(0)
    assert albedo_entropy.minimise_entropy_(scene, problem, no_metal(problem))
    left = scene.sky.log_radiance.detach() - map.log()
    torch.testing.assert_close(believed(scene, problem)[0].log().mean(0), begin)
    return (left - left.mean(0)).abs().mean(0), (change - change.mean(0)).abs().mean(0)


@pytest.mark.parametrize("axis", [0, 2])
def test_a_sky_that_leans_is_put_right(axis):
    scene, problem, _ = painted(lamps(NODES))
    along = problem.transport.direction[:, axis, None]
    left, before = tilt(scene, problem, lamps(NODES), along * torch.tensor([0.8, 0.5, -0.4]))
    # The last steps are of 0.06, half of that is the mean of a harmonic
    assert (left < 0.05).all()
    assert (before > 0.18).all()


def test_a_sun_of_the_wrong_brightness_is_put_right():
    map, node = with_sun(0.6)
    scene, problem, _ = painted(map)
    change = torch.zeros(NODES, 3)
    change[node] = torch.tensor([0.7, 0.7, 0.3])
    known(scene, map * change.exp())
    decisions = replace(no_metal(problem), sun=10 * change)
    albedo_entropy.minimise_entropy_(scene, problem, decisions)
    left = scene.sky.log_radiance.detach() - map.log()
    assert (left[node] - left.median(0).values).abs().max() < 0.1


def test_points_that_nothing_seems_to_reach_spoil_nothing():
    scene, problem, _ = painted(with_sun(0.8)[0])
    visibility = problem.transport.visibility.clone()
    visibility[:50] = 0  # and yet they are bright
    problem = replace(problem, transport=replace(problem.transport, visibility=visibility))
    sun = albedo_entropy.fit_sun_(scene, problem, no_metal(problem))
    assert sun is not None
    albedo_entropy.minimise_entropy_(scene, problem, replace(no_metal(problem), sun=sun.log_excess))
    assert scene.sky.log_radiance.isfinite().all()
    assert albedo_entropy.diffuse_albedo(scene, problem).isfinite().all()


def test_the_right_map_stays():
    scene, problem, albedo = painted(lamps(NODES))
    known(scene, lamps(NODES))
    before = scene.sky.log_radiance.detach().clone()
    assert not albedo_entropy.minimise_entropy_(scene, problem, no_metal(problem))
    torch.testing.assert_close(scene.sky.log_radiance.detach(), before)
    found, point = believed(scene, problem)
    torch.testing.assert_close(found, albedo[point], atol=1e-4, rtol=1e-3)


def test_paint_is_told_from_what_the_layer_mirrors(monkeypatch):
    scene, problem, albedo = painted(lamps(NODES), shiny=True)
    known(scene, lamps(NODES))
    offsets = problem.observations.offsets.clone()
    offsets[1:] = offsets[1:].clamp_min(4) - 4  # nobody sees the first
    seen = replace(
        problem.observations,
        offsets=offsets,
        color=problem.observations.color[4:],
        wo=problem.observations.wo[4:],
        view=problem.observations.view[4:],
    )
    found = albedo_entropy.diffuse_albedo(scene, replace(problem, observations=seen))
    assert found[0].isnan().all()
    mirrored = problem.observations.color.view(POINTS, 4, 3).std(1).mean()
    assert mirrored > 0.01
    torch.testing.assert_close(found[1:], albedo[1:], atol=1e-3, rtol=1e-2)
    # In parts
    monkeypatch.setattr(albedo_entropy, "POINTS_AT_ONCE", 70)
    torch.testing.assert_close(
        albedo_entropy.diffuse_albedo(scene, problem), albedo, atol=1e-3, rtol=1e-2
    )


def test_of_gains_paint_knows_nothing():
    scene, problem, albedo = painted(lamps(NODES), shiny=True)
    known(scene, lamps(NODES))
    scene.views = ViewLights(("a", "b", "c", "d"), 0)
    gains = torch.tensor([0.5, 0.2, -0.3, -0.4])[:, None].expand(4, 3)
    scene.views.add(gains)
    color = scene.exposed(problem.observations.color, problem.observations.view).detach()
    found = albedo_entropy.diffuse_albedo(scene, in_colors(problem, color))
    torch.testing.assert_close(found, albedo, atol=1e-3, rtol=1e-2)


def test_entropy_counts_the_colours():
    torch.manual_seed(0)
    few = torch.randint(8, (2000,))
    colors = 5 * torch.rand(8, 3)
    share = torch.bincount(few) / 2000
    wanted = -(share * share.log()).sum()
    mixed = torch.stack([colors[few], colors[few] + 7.3, 5 * torch.rand(2000, 3)], 1)
    found = albedo_entropy.palette_entropy(mixed, albedo_entropy.CELL)
    torch.testing.assert_close(found[:2], wanted.expand(2), atol=1e-4, rtol=0)
    # Nearly as many cells as points; some share an entry of the table
    assert 0.9 * math.log(2000) < found[2] < math.log(2000)
    assert (5 / albedo_entropy.CELL) ** 3 > 10 * 2000
