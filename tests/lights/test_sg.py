"""Local spherical Gaussian light: its two forms agree, its start, recovery of a known light."""

import pytest
import torch
from balls import ball, shaken, views

from univoxel.core.records import Occlusion
from univoxel.lights import LocalSG, SGConfig, quadrature


@pytest.mark.parametrize("generator", [False, True])
def test_reflected_equals_the_quadrature_of_its_incident(generator):
    surface, light = ball(), shaken(LocalSG(4, SGConfig(directions=128)))
    wo = views(surface)

    def turns():
        return torch.Generator().manual_seed(3) if generator else None

    got = light.reflected(surface, wo, generator=turns())
    wanted = quadrature.reflected(light, surface, wo, 128, generator=turns())
    torch.testing.assert_close(got, wanted, rtol=2e-4, atol=1e-5)
    light.eval()
    wanted = quadrature.reflected(light, surface, wo, 256)
    torch.testing.assert_close(light.reflected(surface, wo), wanted, rtol=2e-4, atol=1e-5)


def test_an_occlusion_hides_the_light():
    surface, light = ball(10), LocalSG(4, SGConfig(directions=128))
    nothing = Occlusion(torch.zeros(10), torch.zeros(10, 128), torch.zeros(10, 128, 3))
    dark = light.reflected(surface, views(surface), nothing)
    assert float(dark.detach().abs().max()) == 0


@pytest.mark.parametrize("lobes", [1, 12, 16, 128])
def test_start_is_white_and_mid_grey(lobes):
    surface, light = ball(), LocalSG(4, SGConfig(lobes=lobes, directions=128))
    rgb = light.reflected(surface, surface.normal).detach()
    torch.testing.assert_close(rgb[:, 0], rgb[:, 2])
    # albedo 0.5 under irradiance pi / 2 gives 0.25, and the layer adds about 0.01
    assert float(rgb.mean()) == pytest.approx(0.26, abs=0.03)
    assert float(light.raw(surface).detach().abs().max()) == 0


def test_lobes_are_in_range_and_finite():
    light, surface = shaken(LocalSG(4, SGConfig(directions=128))), ball()
    axis, sharpness, amplitude = light.lobes(surface)
    torch.testing.assert_close(axis.norm(dim=-1), torch.ones(200, 16))
    assert bool(((sharpness >= 0.1) & (sharpness <= 30.1)).all())
    assert bool((amplitude >= 0).all())
    raw = -light.base.detach().flatten().expand(2, -1).clone().requires_grad_()
    lobes = light.lobes_from_raw(raw)  # zero vectors for axes
    (grad,) = torch.autograd.grad(sum(t.sum() for t in lobes), raw)
    assert bool(grad.isfinite().all())
