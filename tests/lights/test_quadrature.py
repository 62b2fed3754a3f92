"""The generic quadrature: a constant light, an occlusion, bad arguments; its two forms agree."""

from dataclasses import replace

import pytest
import torch
from balls import ball, views

from univoxel import sphere
from univoxel.core.records import Occlusion
from univoxel.lights import AbstractLight, quadrature


class Ramp(AbstractLight):
    """Radiance 1 + slope w.z from everywhere."""

    traced = False
    directions = 64

    def __init__(self, slope):
        super().__init__()
        self.slope = slope

    def incident(self, surface, wi):
        return (1 + self.slope * wi[..., 2:]).expand(len(surface.normal), wi.shape[-2], 3)

    def reflected(self, surface, wo, occlusion=None, generator=None):
        raise NotImplementedError

    def regularisation(self, surface, near):
        raise NotImplementedError


def test_white_furnace():
    s = ball(5, albedo=1.0, roughness=0.7)
    for generator in (None, torch.Generator().manual_seed(0)):
        rgb = quadrature.reflected(Ramp(0.0), s, s.normal, 2048, generator=generator)
        # the fit of the layer's albedo is good to 0.005
        torch.testing.assert_close(rgb, torch.ones(5, 3), atol=0.006, rtol=0)


@pytest.mark.parametrize("seed", [None, 3])
def test_the_compiled_sum_is_the_eager_one(seed):
    """With a gradient to normals the sum is eager, without it compiled, around one normal."""
    s = ball(40, roughness=0.3)
    wo = views(s)

    def turns():
        return None if seed is None else torch.Generator().manual_seed(seed)

    s = replace(s, normal=s.normal.clone().requires_grad_())
    eager = quadrature.reflected(Ramp(0.5), s, wo, 64, generator=turns())
    (gradient,) = torch.autograd.grad(eager.sum(), s.normal)
    assert gradient.abs().max() > 0
    s = replace(s, normal=s.normal.detach())
    compiled = quadrature.reflected(Ramp(0.5), s, wo, 64, generator=turns())
    torch.testing.assert_close(compiled, eager.detach(), rtol=1e-4, atol=1e-6)


def test_shared_directions_come_to_the_same_sum():
    s = ball(50, roughness=0.5)
    wo = views(s)
    light = Ramp(0.5)
    light.directions = 4096
    wanted = quadrature.reflected(light, s, wo, 2048)
    for generator in (None, torch.Generator().manual_seed(0)):
        got = quadrature.reflected_shared(light, s, wo, generator=generator)
        # both are off by their number of directions: about 1 / sqrt(D) of a highlight's share
        torch.testing.assert_close(got, wanted, rtol=0.01, atol=0)


def test_shared_directions_send_the_same_gradient_to_normals():
    s = ball(50, roughness=0.5)
    wo, light = views(s), Ramp(0.5)
    light.directions = 4096
    slopes = []
    for draw in (lambda s: quadrature.reflected(light, s, wo, 2048), lambda s: (
        quadrature.reflected_shared(light, s, wo)
    )):  # fmt: skip
        s = replace(s, normal=ball(50).normal.clone().requires_grad_())
        (slope,) = torch.autograd.grad(draw(s)[:, 0].sum(), s.normal)
        slopes.append(slope - (slope * s.normal).sum(1, keepdim=True) * s.normal)
    # along the sphere; in one the directions turn with the normal, in the other they stand still:
    # both are off by their number, as above, and a slope more so than a value
    torch.testing.assert_close(*slopes, rtol=0, atol=0.03 * slopes[0].abs().max().item())


def test_an_occlusion_takes_light_and_gives_other():
    s = ball(5)
    wo = s.normal
    full = quadrature.reflected(Ramp(0.0), s, wo, 64)
    rotation, nothing = torch.zeros(5), torch.zeros(5, 64, 3)
    half = Occlusion(rotation, torch.full((5, 64), 0.5), nothing)
    torch.testing.assert_close(quadrature.reflected(Ramp(0.0), s, wo, 64, half), full / 2)
    other = Occlusion(rotation, torch.zeros(5, 64), nothing + 3)
    torch.testing.assert_close(quadrature.reflected(Ramp(0.0), s, wo, 64, other), 3 * full)


def test_an_occlusion_brings_its_directions():
    """What hides one side of the turned directions hides light from that side of the world."""
    s, wo = ball(20), ball(20).normal
    rotation = torch.linspace(0, 6, 20)
    wi = quadrature.half_sphere(s, 512, rotation)
    above = (wi[..., 2] > 0).float()
    seen = Occlusion(rotation, above, torch.zeros(20, 512, 3))
    got = quadrature.reflected(Ramp(0.0), s, wo, 512, seen)
    full = quadrature.reflected(Ramp(0.0), s, wo, 512)
    # irradiance of the upper half of the sky is (1 + n.z) / 2 of the whole; seen from above, the
    # rough highlight follows it nearly
    expected = full * (0.5 + 0.5 * s.normal[:, 2:])
    torch.testing.assert_close(got, expected, rtol=0, atol=0.02)


def test_a_generator_turns_each_point_or_the_shared_set_as_a_whole():
    turns = quadrature.rotations(ball(50), torch.Generator().manual_seed(0))
    assert float(turns.std()) > 1
    assert float(quadrature.rotations(ball(50), None).abs().max()) == 0
    still = quadrature.whole_sphere(64, None)
    turned = quadrature.whole_sphere(64, torch.Generator().manual_seed(0))
    torch.testing.assert_close(turned @ turned.T, still @ still.T, atol=1e-5, rtol=0)
    assert (turned - still).abs().max() > 0.1
    assert torch.equal(still, sphere.fibonacci_sphere(64))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"visibility": torch.ones(5, 32)}, r"visibility must be \[5, 64\], got \[5, 32\]"),
        ({"rotation": torch.zeros(4)}, r"rotation must be \[5\], got \[4\]"),
        ({"indirect": torch.zeros(5, 64)}, r"indirect must be \[5, 64, 3\], got \[5, 64\]"),
    ],
)
def test_an_occlusion_of_another_size(change, message):
    s = ball(5)
    seen = Occlusion(torch.zeros(5), torch.ones(5, 64), torch.zeros(5, 64, 3))
    with pytest.raises(ValueError, match=message):
        quadrature.reflected(Ramp(0.0), s, s.normal, 64, replace(seen, **change))
    with pytest.raises(ValueError, match="expected either an occlusion or a generator, got both"):
        quadrature.reflected(Ramp(0.0), s, s.normal, 64, seen, torch.Generator())
