"""Environment maps: axes, interpolation, and the density that they are drawn with."""

import math

import pytest
import torch

from univoxel.envmap import EnvMap, lookup, tables
from univoxel.sphere import latlong_direction, texel_solid_angles


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


def test_density_has_all_of_the_light():
    """It sums up to 1, and wherever a lookup finds light it is above 0."""
    envmap = spotted(16, exposure=1.5)
    density = tables(envmap).texel[..., 3]
    assert (density * texel_solid_angles(16, 32)).sum() == pytest.approx(1.0, abs=1e-4)
    uv = torch.rand(400_000, 2, generator=torch.Generator().manual_seed(0))
    column, row = (uv * torch.tensor([32, 16])).long().unbind(1)
    dark = lookup(envmap, latlong_direction(uv)).sum(1) == 0
    assert 0.1 < dark.float().mean() < 0.5
    assert ((density[row, column] > 0) | dark).all()
    density = tables(EnvMap(torch.zeros(4, 8, 3))).texel[..., 3]
    torch.testing.assert_close(density, torch.full((4, 8), 1 / (4 * math.pi)))


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
