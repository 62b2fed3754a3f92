"""Distant maps: lookup, sums, occlusion, a known map found, its picture; and the one of nodes."""

import math
from dataclasses import replace

import pytest
import torch
from balls import ball, views
from torch.nn.functional import normalize

from univoxel import lights, sphere
from univoxel.core.records import Occlusion
from univoxel.lights.latlong import NODES_AT_ONCE, DistantLight
from univoxel.sphere import direction_to_latlong, latlong_directions, texel_solid_angles

LAMP = normalize(torch.tensor([0.5, -0.3, 0.8]), dim=0)


def lit(wi):
    """A lamp of some 20 degrees in a dim room: [..., 3]."""
    return 0.2 + 4 * (20 * (wi @ LAMP - 1)).exp()[..., None] * torch.tensor([1.0, 1.0, 0.5])


def of_texels(rows=32, **changes):
    light = lights.EnvmapLight(lights.EnvmapConfig(rows=rows, **changes))
    with torch.no_grad():
        light.levels[0] += (lit(latlong_directions(rows)).log() - light.log_radiance) / 30.0
    return light


def of_lobes(**changes):
    light = lights.EnvmapSGLight(lights.EnvmapSGConfig(**changes))
    with torch.no_grad():
        light.raw += 0.05 * torch.randn(light.raw.shape, generator=torch.manual_seed(0))
    return light


def with_room(light, surface, half_open):
    """The occlusion of points that see no light from below z = 0, but a red floor."""
    rotation = torch.zeros(len(surface.normal))
    wi = lights.quadrature.half_sphere(surface, light.directions, rotation)
    above = (wi[..., 2] > 0).float() if half_open else torch.ones(wi.shape[:2])
    floor = torch.tensor([0.3, 0.1, 0.1])
    return Occlusion(rotation, above, (1 - above)[..., None] * floor)


@pytest.mark.parametrize("make", [of_texels, of_lobes])
def test_reflected_equals_the_quadrature_of_its_incident(make):
    surface, light = ball(), make()
    wo = views(surface)
    for directions in (64, 256):
        assert light.directions == directions
        for seen in (None, with_room(light, surface, True)):
            got = light.reflected(surface, wo, seen).detach()
            wanted = lights.quadrature.reflected(light, surface, wo, directions, seen).detach()
            torch.testing.assert_close(got, wanted)
        light.eval()


@torch.no_grad()
def test_texels_are_where_the_conventions_say():
    light = of_texels(64)
    wi = latlong_directions(64)
    found = light.incident(ball(64), wi)
    torch.testing.assert_close(found, lit(wi), rtol=1e-3, atol=1e-4)  # lookups at texels' centres
    torch.testing.assert_close(light.latlong(64), found, rtol=1e-3, atol=1e-4)
    # Halved, the light of all texels is kept; doubled, what is between them is interpolated
    small, large = light.latlong(32), light.latlong(128)
    whole = [m * sphere.texel_solid_angles(*m.shape[:2])[..., None] for m in (found, small, large)]
    torch.testing.assert_close(whole[1].sum((0, 1)), whole[0].sum((0, 1)), rtol=1e-3, atol=0)
    torch.testing.assert_close(whole[2].sum((0, 1)), whole[0].sum((0, 1)), rtol=1e-2, atol=0)


def test_levels_add_up():
    """A step of the coarsest level lifts the whole map, also across the border."""
    light = lights.EnvmapLight(lights.EnvmapConfig(rows=64))
    assert [len(level) for level in light.levels] == [64, 16, 4]
    torch.testing.assert_close(light.log_radiance.exp(), torch.full((64, 128, 3), 0.5))
    with torch.no_grad():
        light.levels[-1][1, 0] += 1 / 30
    added = light.log_radiance[..., 0] - math.log(0.5)
    assert added[24, 8].item() == pytest.approx(1.0, abs=0.1)
    assert added[24, 0].item() == pytest.approx(added[24, 15].item(), abs=1e-3)
    assert added[24, -4].item() > 0.1
    assert added[24, 60].item() == pytest.approx(0.0, abs=1e-4)


@torch.no_grad()
def test_lobes_are_on_the_map_what_their_formula_says():
    light = of_lobes()
    axis, sharpness, amplitude = light.lobes()
    wi = sphere.fibonacci_sphere(2000)
    exact = (sharpness * (wi @ axis.T - 1)).exp() @ amplitude
    got = light.incident(ball(1), wi[None])[0]
    # interpolation is off by sharpness (pi / rows)^2 / 4 of each amplitude at most
    bound = (0.25 * sharpness * (math.pi / 64) ** 2) @ amplitude
    assert bool(((got - exact).abs() < bound + 1e-4).all())
    torch.testing.assert_close(
        light.latlong(16), ((latlong_directions(16) @ axis.T - 1) * sharpness).exp() @ amplitude
    )


def test_starts_are_even():
    wi = sphere.fibonacci_sphere(100)[None]
    # lobes are as wide as 0.4 of what they lie apart
    texels = lights.EnvmapLight().incident(ball(1), wi).detach()
    torch.testing.assert_close(texels, torch.full((1, 100, 3), 0.5))
    lobes = lights.EnvmapSGLight().incident(ball(1), wi).detach()
    torch.testing.assert_close(lobes, torch.full((1, 100, 3), 0.5), atol=0.12, rtol=0)


def test_no_gradient_to_normals_and_one_to_map_and_materials():
    for light in (lights.EnvmapLight(lights.EnvmapConfig(rows=16)), lights.EnvmapSGLight()):
        surface = ball(20)
        leaves = [
            t.clone().requires_grad_() for t in (surface.normal, surface.albedo, surface.roughness)
        ]
        normal, albedo, roughness = leaves
        surface = replace(surface, normal=normal, albedo=albedo, roughness=roughness)
        seen = with_room(light, ball(20), True)
        light.reflected(surface, views(ball(20)), seen).sum().backward()
        assert normal.grad is None
        assert albedo.grad.abs().min() > 0
        assert roughness.grad.abs().max() > 0
        assert all(p.grad.abs().max() > 0 for p in light.parameters())


def fit(light, surface, wo, target, parameters, steps, lr, turned=True, map_smoothness=0.0):
    """Minimise the squared error of what is reflected; the last error over the first."""
    optimizer = torch.optim.Adam(parameters, lr=lr)
    g = torch.Generator().manual_seed(0) if turned else None
    errors = []
    for i in range(steps):
        optimizer.param_groups[0]["lr"] = lr * 0.1 ** (i / steps)
        loss = (light.reflected(surface, wo, generator=g) - target).square().mean()
        optimizer.zero_grad()
        prior = light.regularisation(surface, surface).map_smoothness
        (loss if prior is None else loss + map_smoothness * prior).backward()
        optimizer.step()
        errors.append(loss.item())
    return errors[-1] / errors[0]


@pytest.mark.parametrize("kind", ["texels", "lobes"])
def test_recovers_a_known_light_behind_an_occluder(kind):
    """A ball that lies on a red floor: with the occlusion the sky comes out, without it does not.

    Below the horizon nothing says what the map is; above, reflection leaves a third of its norm
    open, as it does for other lights.
    """
    surface = replace(ball(150, roughness=0.25), features=torch.zeros(150, 4))
    wo = views(surface)
    truth = of_texels(rows=32, directions=128)
    with torch.no_grad():
        target = truth.reflected(surface, wo, with_room(truth, surface, True))
    errors = []
    wi = sphere.fibonacci_sphere(500)
    wi = wi[wi[:, 2] > 0.1][None]
    for known in (True, False):
        if kind == "texels":
            light = lights.EnvmapLight(lights.EnvmapConfig(rows=32, directions=128))
        else:
            light = lights.EnvmapSGLight(lights.EnvmapSGConfig(lobes=32, rows=32, directions=128))
        seen = with_room(light, surface, known)
        light.reflected, reflect = (
            lambda s, w, generator=None, r=light.reflected, o=seen: r(s, w, o),
            light.reflected,
        )
        left = fit(light, surface, wo, target, list(light.parameters()), 100, 3e-3, True, 3e-4)
        light.reflected = reflect
        if known:
            assert left < 0.02
        got = light.incident(surface, wi)[0].detach()
        errors.append(float((got - lit(wi[0])).norm() / lit(wi[0]).norm()))
    assert errors[0] < 0.33
    assert errors[0] < errors[1]


@torch.no_grad()
def test_regularisation_sees_noise_and_colour():
    light, s = lights.EnvmapLight(lights.EnvmapConfig(rows=16)), ball(1)
    even = light.regularisation(s, s)
    assert even.map_smoothness == pytest.approx(0.0, abs=1e-6)
    light.levels[0][..., 0] += 0.02 * torch.rand(16, 32)
    noisy = light.regularisation(s, s)
    assert noisy.map_smoothness > 0.1
    assert noisy.white_light > even.white_light
    red = of_lobes()
    before = red.regularisation(s, s).white_light
    # in closed form, what the map sums up to
    torch.testing.assert_close(before, lights.latlong.chroma(red.latlong(64)), rtol=1e-3, atol=1e-4)
    red.raw[:, 4] += 0.1
    assert red.regularisation(s, s).white_light > before


def light_with(node: int, radiance: float, count: int = 512) -> DistantLight:
    light = DistantLight(count, 0.01)
    with torch.no_grad():
        light.log_radiance[node] = math.log(radiance)
    return light


def test_a_constant_map_is_constant_everywhere():
    light = DistantLight(100, 0.7)
    wi = normalize(torch.randn(NODES_AT_ONCE + 3, 3), dim=1)  # more than are done at once
    assert torch.allclose(light.incident(wi), torch.tensor(0.7), rtol=1e-5)
    assert torch.allclose(light.latlong(4), torch.full((4, 8, 3), 0.7), rtol=1e-5)


@torch.no_grad()
def test_incident_at_a_node_is_near_its_radiance():
    torch.manual_seed(0)
    light = DistantLight(512)
    # Smooth over the sphere: what is between two nodes is then between their radiances
    light.log_radiance.copy_(light.direction)
    error = light.incident(light.direction) / light.radiance - 1
    # The Gaussians reach the neighbours, 9 degrees away: what they add cancels to first order
    assert error.abs().max() < 0.03


@torch.no_grad()
@pytest.mark.parametrize("node", [3, 100, 256, 300, 509])
def test_a_bright_node_is_where_the_conventions_say(node):
    height = 64
    light = light_with(node, 100.0)
    picture = light.latlong(height)[..., 0]
    row, column = divmod(int(picture.argmax()), 2 * height)
    x, y, z = light.direction[node].tolist()
    # docs/reference/conventions.md, solved for column and row
    assert abs(row + 0.5 - height * (0.5 - math.asin(z) / math.pi)) < 1
    away = (column + 0.5 - 2 * height * (math.pi - math.atan2(y, x)) / (2 * math.pi)) % (2 * height)
    assert min(away, 2 * height - away) * math.sqrt(1 - z * z) < 1.5  # columns narrow to the poles
    u, v = direction_to_latlong(light.direction[node]).tolist()
    assert picture[int(v * height), int(u * 2 * height)] > 0.9 * picture.max()


@torch.no_grad()
def test_a_nodes_light_is_kept_by_the_map():
    light = light_with(200, 50.0)
    picture = light.latlong(64)
    total = (picture * texel_solid_angles(64, 128)[..., None]).sum((0, 1))
    nodes = light.radiance.sum(0) * 4 * math.pi / 512
    assert torch.allclose(total, nodes, rtol=0.05)  # the spiral is even to a few per cent


def test_the_map_takes_gradients():
    light = DistantLight(32)
    light.incident(torch.tensor([[0.0, 0.0, 1.0]])).sum().backward()
    gradient = light.log_radiance.grad
    # Softmax weights sum to 1, and the radiance is 1: so do the derivatives of each channel
    assert torch.allclose(gradient.sum(0), torch.ones(3), rtol=1e-5)
    assert gradient.sum(1).argmax() == light.direction[:, 2].argmax()


def test_texels_that_are_sharper_than_the_nodes_are_the_map():
    light = DistantLight(32, 0.7, rows=8)
    light.sharp += torch.arange(16.0)[:, None]
    assert torch.allclose(light.latlong(8), light.sharp, atol=1e-5)
    assert torch.allclose(light.latlong(4)[:, 0], torch.tensor(0.5))
    assert torch.allclose(light.incident(light.direction), torch.tensor(0.7))
    assert light.changed(torch.zeros(32, 3)).sharp is None
