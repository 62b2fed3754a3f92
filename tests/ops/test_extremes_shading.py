"""Values at the edge of float32 in the shading ops, see test_extremes.py."""

import math

import pytest
import torch
from extremes import check_finite, few, pick, run, same, seeds, shading
from hypothesis import given
from hypothesis import strategies as st

from univoxel import ops, sphere
from univoxel.ops import native

pytestmark = pytest.mark.skipif(native.core is None, reason="without the extension")
f0s = st.sampled_from([0.0, 0.04, 1.0, None])


# --- shade_sg


def reflectance(seed, n, kind):
    """A number, or an F0 per channel."""
    g = torch.Generator().manual_seed(seed + 1)
    return pick(g, (0.0, 1.0, 1e-45), n, 3).clamp(0, 1).requires_grad_() if kind is None else kind


@few
@given(seeds, st.integers(0, 5), st.integers(0, 3), f0s)
def test_shade_sg_is_finite(seed, n, k, f0):
    f0 = reflectance(seed, n, f0)
    check_finite(ops.shade_sg, ops.shade_sg_reference, (*shading(seed, n, k), f0))


@few
@given(seeds, st.integers(0, 3), st.sampled_from([0, 1, 2, 3, 4, 5, 6, 8, 9]))
def test_shade_sg_keeps_nan_at_its_point(seed, point, argument):
    arguments = [*shading(seed, 4, 2), reflectance(seed, 4, None)]
    before = run(ops.shade_sg, arguments)
    with torch.no_grad():
        arguments[argument][point] = math.nan
    after = run(ops.shade_sg, arguments)
    others = torch.arange(4) != point
    for a, b in zip(before, after, strict=True):
        assert same(a[others], b[others])


# --- shade_radiance, shade_map


def under_light(seed, n, count=16):
    """Light, then what shade_radiance and shade_map share; normals and eyes of `shading`."""
    g = torch.Generator().manual_seed(seed)
    _, _, _, normal, wo, albedo, roughness, *_ = shading(seed, n, 1)
    light = pick(g, (0.0, 1e-45, 1.0, 1e6), n, count, 3).abs().requires_grad_()
    directions = sphere.fibonacci_sphere(count)
    rest = (normal, wo.detach(), albedo, roughness, directions, 4 * math.pi / count)
    return light, rest


@few
@given(seeds, st.integers(0, 5), f0s)
def test_shade_under_given_light_is_finite(seed, n, f0):
    light, rest = under_light(seed, n)
    f0 = reflectance(seed, n, f0)
    check_finite(ops.shade_radiance, ops.shade_radiance_reference, (light, *rest, f0))
    g = torch.Generator().manual_seed(seed)
    visibility = torch.rand(4, 16, generator=g).round(decimals=1)
    indirect = pick(g, (0.0, 1e-45, 1.0, 1e6), 4, 16, 3).abs()
    map = pick(g, (0.0, 1e-45, 1.0, 1e6), 16, 3).abs().requires_grad_()
    mapped = (map, visibility, indirect, torch.arange(n) % 4, *rest, f0)
    check_finite(ops.shade_map, ops.shade_map_reference, mapped)


@few
@given(seeds, st.integers(0, 3), st.sampled_from(["light", 0, 1, 2, 3, 6]))
def test_shade_under_given_light_keeps_nan_at_its_point(seed, point, argument):
    light, rest = under_light(seed, 4)
    rest = (*rest, reflectance(seed, 4, None))
    before = run(ops.shade_radiance, (light, *rest))
    with torch.no_grad():
        (light if argument == "light" else rest[argument])[point] = math.nan
    after = run(ops.shade_radiance, (light, *rest))
    others = torch.arange(4) != point
    for a, b in zip(before, after, strict=True):
        assert same(a[others], b[others])
