"""Local light as networks: directions of all points, a known light found."""

from dataclasses import replace

import torch
from balls import ball, fit, shaken, views

from univoxel import sphere
from univoxel.lights import LocalMLP, MLPLightConfig


def made(**changes):
    return LocalMLP(4, MLPLightConfig(**changes), torch.Generator().manual_seed(0))


def test_shared_directions_say_the_same_as_a_points_own():
    surface, light, wi = ball(7), shaken(made()), sphere.fibonacci_sphere(12)
    own = light.incident(surface, wi.expand(7, 12, 3))
    torch.testing.assert_close(light.incident(surface, wi), own)


def test_recovers_a_known_light():
    """A ball under a lamp of 30 degrees in a dim room: found from what it reflects."""
    surface = replace(ball(150, roughness=0.25), features=torch.zeros(150, 4))
    wo = views(surface)
    lamp = torch.nn.functional.normalize(torch.tensor([0.5, -0.3, 0.8]), dim=0)

    def room(wi):
        return 0.2 + 3 * (12 * (wi @ lamp - 1)).exp()[..., None] * torch.tensor([1.0, 1.0, 0.4])

    light = made(directions=256)
    truth = made()
    truth.incident = lambda surface, wi: room(wi).expand(150, -1, 3).contiguous()
    with torch.no_grad():
        target = truth.eval().reflected(surface, wo)
    # Not the head: what falls on the ball is the same everywhere, and a ball determines it
    parameters = [light.base, *light.basis_net.parameters()]
    assert fit(light, surface, wo, target, parameters, 200, 0.01) < 1e-2
    wi = sphere.fibonacci_sphere(500)
    got = light.incident(surface, wi)[0].detach()
    # Reflection blurs light: a third of its norm is what it leaves open
    assert float((got - room(wi)).norm() / room(wi).norm()) < 0.33
