"""What all local lights have in common, whatever a point's light is put together of."""

import pytest
import torch
from balls import ball, shaken, views

from univoxel import sphere
from univoxel.lights import LocalMLP, LocalSG, LocalSH, MLPLightConfig, SHConfig, quadrature

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


@pytest.mark.parametrize("kind", ["sh", "mlp"])
def test_start_is_even(kind):
    radiance = LIGHTS[kind]().incident(ball(), sphere.fibonacci_sphere(40)).detach()
    torch.testing.assert_close(radiance, torch.full((200, 40, 3), 0.5))


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
