"""The specular layer's rows: against the reference, and as the shading that they are part of."""

import math

import pytest
import torch

from univoxel import brdf, sphere
from univoxel.ops import shade_radiance, specular_response, use_backend


def case(count=40, directions=96, dtype=torch.float64, seed=0):
    g = torch.Generator().manual_seed(seed)
    normal, wo = torch.nn.functional.normalize(
        torch.randn(2, count, 3, generator=g, dtype=dtype), dim=-1
    )
    roughness = torch.rand(count, generator=g, dtype=dtype)
    return (
        normal,
        wo,
        roughness,
        sphere.fibonacci_sphere(directions, dtype),
        4 * math.pi / directions,
    )


# float32: D's denominator at low roughness, as for the ops that shade
@pytest.mark.parametrize(("dtype", "rtol"), [(torch.float32, 1e-4), (torch.float64, 1e-12)])
@pytest.mark.parametrize("f0", [0.0, 0.04, 1.0])
def test_it_equals_its_reference(dtype, rtol, f0):
    *arguments, solid_angle = case(dtype=dtype)
    found = specular_response(*arguments, solid_angle, f0)
    with use_backend("reference"):
        wanted = specular_response(*[a.double() for a in arguments], solid_angle, f0)
    assert found.dtype == dtype
    assert (found.double() - wanted).norm() < rtol * wanted.norm()
    below = arguments[0] @ arguments[3].T < -1e-6
    assert 0.3 < below.double().mean() < 0.7
    assert (found[below] == 0).all()


def test_light_times_its_rows_is_what_shading_gives_black_points():
    normal, wo, roughness, directions, solid_angle = case()
    map = torch.rand(len(directions), 3, dtype=torch.float64)
    found = specular_response(normal, wo, roughness, directions, solid_angle) @ map
    light, black = map.expand(len(normal), -1, -1), torch.zeros_like(normal)
    wanted = shade_radiance(light, normal, wo, black, roughness, directions, solid_angle, brdf.F0)
    torch.testing.assert_close(found, wanted)


def test_no_points_have_no_rows():
    assert specular_response(*case(count=0)).shape == (0, 96)
