"""The generic quadrature: a constant light, visibility, bad arguments."""

import pytest
import torch

from univoxel import sphere
from univoxel.lights import AbstractLight, quadrature
from univoxel.records import Surface


class White(AbstractLight):
    def incident(self, surface, wi):
        return torch.ones_like(wi)

    def reflected(self, surface, wo, visibility=None, generator=None):
        raise NotImplementedError


def surface(n=5, features=0, roughness=0.7):
    normal = sphere.fibonacci_sphere(n)
    return Surface(
        position=normal,
        normal=normal,
        features=torch.zeros(n, features),
        albedo=torch.full((n, 3), 1.0),
        roughness=torch.full((n,), roughness),
        opacity=torch.ones(n),
        depth=torch.ones(n),
    )


def test_white_furnace():
    s = surface()
    for generator in (None, torch.Generator().manual_seed(0)):
        rgb = quadrature.reflected(White(), s, s.normal, 2048, generator=generator)
        # the fit of the layer's albedo is good to 0.005
        torch.testing.assert_close(rgb, torch.ones(5, 3), atol=0.006, rtol=0)


def test_visibility_scales_the_light():
    s = surface()
    full = quadrature.reflected(White(), s, s.normal, 64)
    half = quadrature.reflected(White(), s, s.normal, 64, torch.full((5, 64), 0.5))
    torch.testing.assert_close(half, full / 2)


def test_a_generator_turns_each_point():
    turns = quadrature.rotations(surface(50), torch.Generator().manual_seed(0))
    assert float(turns.std()) > 1
    assert float(quadrature.rotations(surface(50), None).abs().max()) == 0


def test_bad_arguments():
    s = surface()
    with pytest.raises(ValueError, match=r"visibility must be \[5, 64\], got \[5, 32\]"):
        quadrature.reflected(White(), s, s.normal, 64, torch.ones(5, 32))
    with pytest.raises(ValueError, match="visibility needs fixed directions"):
        quadrature.reflected(White(), s, s.normal, 64, torch.ones(5, 64), torch.Generator())
