"""What local lights have in common, their priors, and the network of what is mirrored sharply."""

import math
from dataclasses import replace

import pytest
import torch
from balls import ball, shaken, surface_at, views
from torch.nn.functional import normalize

from univoxel import brdf, sphere
from univoxel.core.records import Surface
from univoxel.lights import LocalMLP, LocalSG, LocalSH, MLPLightConfig, SHConfig, base, quadrature
from univoxel.lights.base import MirroredLight
from univoxel.ops.networks import DirectionTable
from univoxel.sphere import latlong_directions

FINE = {"directions": 4096, "directions_eval": 1024}
LIGHTS = {
    "sg": lambda: LocalSG(4),
    "sh": lambda: LocalSH(4, SHConfig(**FINE)),
    "mlp": lambda: LocalMLP(
        4, MLPLightConfig(**FINE, frequencies=2), torch.Generator().manual_seed(0)
    ),
}


@pytest.mark.parametrize("kind", ["sh", "mlp"])
def test_reflected_equals_the_quadrature_of_its_incident(kind):
    surface, light = ball(60), shaken(LIGHTS[kind]())
    wo = views(surface)
    wanted = quadrature.reflected(light, surface, wo, 2048).detach()
    for generator in (None, torch.Generator().manual_seed(3)):
        got = light.reflected(surface, wo, generator=generator).detach()
        # either sum is off by its number of directions
        torch.testing.assert_close(got, wanted, rtol=0.01, atol=1e-3)
    light.eval()
    assert light.directions == 1024
    torch.testing.assert_close(light.reflected(surface, wo).detach(), wanted, rtol=0.03, atol=1e-3)


def test_shared_directions_say_the_same_as_a_points_own():
    surface, light, wi = ball(7), shaken(LIGHTS["mlp"]()), sphere.fibonacci_sphere(12)
    own = light.incident(surface, wi.expand(7, 12, 3))
    torch.testing.assert_close(light.incident(surface, wi), own)


@pytest.mark.parametrize("kind", ["sh", "mlp"])
def test_start_is_even(kind):
    radiance = LIGHTS[kind]().incident(ball(), sphere.fibonacci_sphere(40)).detach()
    torch.testing.assert_close(radiance, torch.full((200, 40, 3), 0.5))


@pytest.mark.parametrize("kind", LIGHTS)
def test_gradients_reach_normals_materials_and_all_of_the_light(kind):
    surface, light = ball(20), shaken(LIGHTS[kind]())
    names = "normal", "albedo", "roughness"
    leaves = {name: getattr(surface, name).clone().requires_grad_() for name in names}
    light.reflected(replace(surface, **leaves), views(surface)).sum().backward()
    for name, leaf in (*leaves.items(), *light.named_parameters()):
        assert leaf.grad.isfinite().all(), name
        assert leaf.grad.abs().max() > 0, name


@pytest.mark.parametrize("kind", LIGHTS)
def test_regularisation_sees_change_and_colour(kind):
    light, here, near = shaken(LIGHTS[kind]()), ball(), ball(seed=1)
    assert light.regularisation(here, here).light_smoothness == 0
    before = light.regularisation(here, near)
    assert before.light_smoothness > 0
    with torch.no_grad():
        if kind == "sg":
            light.base[:, 4] += 2.0  # the red of every lobe
        else:
            light.base[0, 0] += 5.0
    assert light.regularisation(here, near).white_light > before.white_light


def test_chroma_is_of_the_sum_and_smoothness_vanishes_where_equal():
    assert base.chroma(torch.ones(1, 3)).item() == pytest.approx(0.0, abs=1e-6)
    assert base.chroma(torch.tensor([[1.0, 0.0, 0.0]])).item() > 0.5
    # not the brightness: twice the light has the same chroma
    tinted = torch.tensor([[1.0, 0.9, 0.8]])
    assert base.chroma(2 * tinted).item() == pytest.approx(base.chroma(tinted).item())
    a = torch.rand(5, 7)
    assert base.smoothness(a, a) == 0
    assert base.smoothness(a + 0.5, a).item() == pytest.approx(0.5)


@pytest.mark.parametrize("axis", [[0.0, 0, 1], [1.0, 0, 0], [0.6, 0, 0.8]])
def test_total_variation_of_a_ramp(axis):
    """log L = k axis.w has a gradient of k sin(angle to the axis), wherever the axis points."""
    k = 2.0
    ramp = (k * latlong_directions(128) @ torch.tensor(axis))[..., None].expand(-1, -1, 3)
    t = torch.linspace(0, math.pi, 20001, dtype=torch.float64)
    integrand = ((1 + (k * t.sin()) ** 2).sqrt() - 1) * t.sin() / 2
    wanted = torch.trapezoid(integrand, t).item()
    # the rows beside the poles see the ramp at finite steps: about one in 128 of the map
    assert base.total_variation(ramp).item() == pytest.approx(wanted, rel=0.01)


def test_total_variation_knows_no_seam_and_no_level():
    torch.manual_seed(0)
    noise = torch.randn(16, 32, 3)
    value = base.total_variation(noise)
    torch.testing.assert_close(base.total_variation(noise.roll(5, 1)), value)
    torch.testing.assert_close(base.total_variation(noise + 3), value)
    assert base.total_variation(torch.ones(1, 2, 3)) == 0
    even = torch.ones(8, 16, 3, requires_grad=True)
    base.total_variation(even).backward()
    assert bool(even.grad.isfinite().all())


NO_TABLE = DirectionTable(0)


def mirror_ball(n: int, metallic: float) -> tuple[Surface, torch.Tensor]:
    """Points of a ball of radius 1, and unit directions to the eye on their side."""
    normal = normalize(torch.randn(n, 3), dim=1)
    wo = normalize(normal + 0.7 * normalize(torch.randn(n, 3), dim=1), dim=1)
    material = {"albedo": 1.0, "roughness": 0.1, "metallic": metallic * torch.ones(n)}
    return surface_at(normal, normal, features=torch.zeros(n, 2), **material), wo


def test_adds_nothing_at_first():
    surface, wo = mirror_ball(50, 1.0)
    assert not MirroredLight(2, 8, 1.0)(surface, wo, NO_TABLE).any()


def test_learns_an_edge_that_no_lobe_has():
    torch.manual_seed(0)
    head = MirroredLight(2, 32, 1.0)
    optimizer = torch.optim.Adam(head.parameters(), lr=1e-2)

    def error() -> torch.Tensor:
        surface, wo = mirror_ball(512, 1.0)
        mirrored = 2 * (surface.normal * wo).sum(1, keepdim=True) * surface.normal - wo
        sky = (mirrored[:, 2:] > 0).float()  # white above the horizon, black below
        share = brdf.specular_albedo((surface.normal * wo).sum(1), surface.roughness, 1.0)
        return (head(surface, wo, NO_TABLE) - share[:, None] * sky).square().mean()

    before = error().item()
    for _ in range(150):
        optimizer.zero_grad()
        error().backward()
        optimizer.step()
    assert error() < 0.1 * before  # one radiance for all leaves half of it


def test_a_dielectric_mirrors_as_much_less_as_its_layer_reflects():
    torch.manual_seed(0)
    head = MirroredLight(2, 8, 1.0)
    torch.nn.init.normal_(head.net.linear[-1].weight)
    surface, wo = mirror_ball(50, 1.0)
    cosine = (surface.normal * wo).sum(1)
    whole = brdf.specular_albedo(cosine, surface.roughness, 1.0)[:, None]
    metal = head(surface, wo, NO_TABLE) / whole
    surface = Surface(**{**vars(surface), "metallic": None})
    share = brdf.specular_albedo(cosine, surface.roughness, brdf.F0)[:, None]
    torch.testing.assert_close(head(surface, wo, NO_TABLE), share * metal)


def test_reads_the_table_where_the_eye_is_mirrored():
    (surface, wo), asked = mirror_ball(50, 1.0), []

    class Watched(DirectionTable):
        def forward(self, direction):
            asked.append(direction)
            return super().forward(direction)

    MirroredLight(2, 8, 1.0, known=4)(surface, wo, Watched(2))
    # Halfway between both lies the normal
    torch.testing.assert_close(normalize(asked[0] + wo, dim=1), surface.normal)
    torch.testing.assert_close(asked[0].norm(dim=1), torch.ones(50))
