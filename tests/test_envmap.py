"""Environment maps: axes, interpolation, and a sampler that draws what its density says."""

import math

import pytest
import torch
from scipy import stats

from univoxel.envmap import EnvMap, lookup, pdf, sample, tables
from univoxel.sphere import fibonacci_sphere, latlong_direction


def spotted(height=8, seed=0, **kwargs):
    g = torch.Generator().manual_seed(seed)
    radiance = torch.rand(height, 2 * height, 3, generator=g) ** 4
    radiance[height // 2 :, : height // 2] = 0
    radiance[1, 3] = 20.0
    return EnvMap(radiance, **kwargs)


def centres(height):
    """Directions of the pixel centres, as of docs/reference/conventions.md: [H, W, 3]."""
    phi = math.pi - 2 * math.pi * (torch.arange(2 * height) + 0.5) / (2 * height)
    theta = math.pi / 2 - math.pi * (torch.arange(height) + 0.5) / height
    theta, phi = torch.meshgrid(theta, phi, indexing="ij")
    return torch.stack([theta.cos() * phi.cos(), theta.cos() * phi.sin(), theta.sin()], -1)


def test_lookup_at_pixel_centres_gives_the_pixels():
    envmap = spotted(exposure=2.0)
    got = lookup(envmap, centres(8))
    torch.testing.assert_close(got, 2 * envmap.radiance, rtol=1e-4, atol=1e-4)


def test_axes():
    """Row 0 is +Z, the centre column +X, W/4 +Y, the border -X."""
    uv = torch.tensor([[0.5, 0.0], [0.5, 0.5], [0.25, 0.5], [0.75, 0.5], [0.0, 0.5]])
    wanted = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0], [0, -1, 0], [-1, 0, 0]])
    torch.testing.assert_close(latlong_direction(uv), wanted, rtol=0, atol=1e-6)
    radiance = torch.zeros(64, 128, 3)
    radiance[31:33, 31:33, 0] = 1  # around W/4: light from +Y
    found = lookup(EnvMap(radiance), wanted)[:, 0]
    assert found.tolist() == pytest.approx([0, 0, 1, 0, 0], abs=1e-4)
    turned = lookup(EnvMap(radiance, rotation=90.0), wanted)[:, 0]  # from +Y to -X
    assert turned.tolist() == pytest.approx([0, 0, 0, 0, 1], abs=1e-4)


def test_lookup_interpolates_across_the_border_and_stops_at_the_poles():
    envmap = spotted()
    texel = envmap.radiance
    theta = math.pi / 2 - math.pi * 2.5 / 8
    border = torch.tensor([[-math.cos(theta), 0.0, math.sin(theta)]])
    torch.testing.assert_close(lookup(envmap, border)[0], (texel[2, 0] + texel[2, -1]) / 2)
    phi = math.pi - 2 * math.pi * 3.5 / 16
    near = 0.01  # above the centre of the top row
    pole = torch.tensor([[near * math.cos(phi), near * math.sin(phi), math.sqrt(1 - near**2)]])
    torch.testing.assert_close(lookup(envmap, pole)[0], texel[0, 3], rtol=1e-4, atol=1e-5)


def test_lookup_gradient():
    envmap = spotted()
    direction = torch.tensor([[0.3, -0.5, 0.4], [-0.2, 0.7, -0.6]]).double().requires_grad_()

    def radiance_along(d):
        return lookup(envmap, d / d.norm(dim=1, keepdim=True))

    assert torch.autograd.gradcheck(radiance_along, direction)


@pytest.mark.parametrize("rotation", [0.0, 77.0])
def test_sampler_draws_what_its_density_says(rotation):
    """Chi-square over cells of equal solid angle: counts against the integral of the density."""
    table = tables(spotted(rotation=rotation))
    n, rows, columns = 200_000, 16, 32
    g = torch.Generator().manual_seed(1)
    direction, density = sample(table, torch.rand(n, 2, generator=g))
    torch.testing.assert_close(direction.norm(dim=1), torch.ones(n))
    torch.testing.assert_close(pdf(table, direction), density, rtol=0.02, atol=1e-6)

    def cell(d):
        z = ((1 - d[:, 2]) / 2 * rows).long().clamp(0, rows - 1)
        turn = (torch.atan2(d[:, 1], d[:, 0]) / (2 * math.pi)) % 1
        return z * columns + (turn * columns).long().clamp(0, columns - 1)

    many = fibonacci_sphere(2_000_000)
    expected = torch.zeros(rows * columns).double()
    expected.index_add_(0, cell(many), pdf(table, many).double() * (4 * math.pi / len(many)))
    assert expected.sum() == pytest.approx(1.0, abs=2e-3)
    counts = torch.bincount(cell(direction), minlength=rows * columns).double()
    full = expected * n > 20
    assert counts[expected * n < 1e-6].sum() == 0
    chi2 = ((counts - expected * n) ** 2 / (expected * n))[full].sum().item()
    # The quadrature of the density has an error of its own, so a 1 in 10^4 chance is the floor.
    assert stats.chi2.sf(chi2, int(full.sum()) - 1) > 1e-4


def test_light_is_never_missed_and_black_rarely_drawn():
    """The estimate of the map's integral is exact in the mean, and nearly without noise."""
    envmap = spotted(16, exposure=1.5)
    many = fibonacci_sphere(400_000)
    light = lookup(envmap, many)
    assert ((pdf(tables(envmap), many) > 0) | (light.sum(1) == 0)).all()
    g = torch.Generator().manual_seed(2)
    direction, density = sample(tables(envmap), torch.rand(100_000, 2, generator=g))
    estimate = (lookup(envmap, direction) / density[:, None]).mean(0)
    wanted = light.mean(0) * 4 * math.pi
    torch.testing.assert_close(estimate, wanted, rtol=0.01, atol=0)


def test_black_map_is_drawn_uniformly():
    table = tables(EnvMap(torch.zeros(4, 8, 3)))
    direction, density = sample(table, torch.rand(100, 2))
    torch.testing.assert_close(density, torch.full((100,), 1 / (4 * math.pi)))
    assert direction.isfinite().all()


def test_ends_of_the_unit_square():
    table = tables(spotted())
    corner = 1 - 2**-24
    uniform = torch.tensor([[0.0, 0.0], [corner, corner], [0.0, corner], [corner, 0.0]])
    direction, density = sample(table, uniform)
    assert density.gt(0).all()
    torch.testing.assert_close(direction.norm(dim=1), torch.ones(4))


@pytest.mark.parametrize(
    ("radiance", "options", "message"),
    [
        (torch.ones(4, 4, 3), {}, r"with W = 2 H, got \[4, 4, 3\]"),
        (torch.ones(4, 8), {}, r"an array \[H, W, 3\].*got \[4, 8\]"),
        (torch.ones(0, 0, 3), {}, r"got \[0, 0, 3\]"),
        (torch.ones(4, 8, 3).double(), {}, "expected float32 radiance, got torch.float64"),
        (-torch.ones(4, 8, 3), {}, "at least 0, got -1.0 in row 0, column 0 and 95 more"),
        (torch.full((4, 8, 3), math.nan), {}, "finite radiance .*got nan"),
        (torch.full((4, 8, 3), math.inf), {}, "finite radiance .*got inf"),
        (torch.ones(4, 8, 3), {"rotation": math.inf}, "rotation must be finite, got inf"),
        (torch.ones(4, 8, 3), {"exposure": -1.0}, "exposure must be finite and at least 0"),
    ],
)
def test_bad_maps(radiance, options, message):
    with pytest.raises(ValueError, match=message):
        EnvMap(radiance, **options)
