"""Shading from given directions: against the reference, closed forms, extremes."""

import math

import pytest
import torch
from check_op import SHADING_RTOL, check_op, uniform, unit

from univoxel import sphere
from univoxel.ops import shade_map, shade_map_reference, shade_radiance, shade_radiance_reference
from univoxel.ops.shade import _shade_radiance


def surface(g, n, count, roughness=(0.2, 1.0)):
    """normal, wo, albedo, roughness, directions, solid_angle."""
    normal = unit(g, n)
    wo = torch.nn.functional.normalize(normal + 0.8 * unit(g, n), dim=-1)
    albedo = uniform(g, 0, 1, n, 3).requires_grad_()
    roughness = uniform(g, *roughness, n).requires_grad_()
    directions = sphere.fibonacci_sphere(count, torch.float64)
    return normal, wo, albedo, roughness, directions, 4 * math.pi / count


def lit(n, count, seed=0, roughness=(0.2, 1.0), f0=0.04):
    g = torch.Generator().manual_seed(seed)
    radiance = uniform(g, 0, 2, n, count, 3).requires_grad_()
    return (radiance, *surface(g, n, count, roughness), f0)


def mapped(n, count, points=5, seed=0, roughness=(0.2, 1.0), f0=0.04):
    """Halves in float64: exact in every dtype. Visibility in 255ths."""
    g = torch.Generator().manual_seed(seed)
    map = uniform(g, 0, 2, count, 3).requires_grad_()
    visibility = torch.randint(0, 256, (points, count), generator=g, dtype=torch.uint8)
    indirect = uniform(g, 0, 1, points, count, 3).half().double()
    index = torch.randint(0, max(points, 1), (n,), generator=g)
    return (map, visibility, indirect, index, *surface(g, n, count, roughness), f0)


def metals(case, seed=1):
    """The same with an F0 per channel, black and white among them, and normals to learn."""
    n = len(case[-7])
    f0 = uniform(torch.Generator().manual_seed(seed), 0, 1, n, 3)
    f0[:1, 0], f0[:1, 1] = 0, 1
    return *case[:-7], case[-7].clone().requires_grad_(), *case[-6:-1], f0.requires_grad_()


def for_unit_normals(op, at):
    """gradcheck moves normals off the sphere, where op and reference need not agree."""

    def normalised(*case):
        unit = torch.nn.functional.normalize(case[at], dim=-1)
        return op(*case[:at], unit, *case[at + 1 :])

    return normalised


def detached(case, dtype=torch.float32):
    return [
        a.detach().to(dtype) if isinstance(a, torch.Tensor) and a.is_floating_point() else a
        for a in case
    ]


def in_halves(op):
    return lambda map, visibility, indirect, *rest: op(map, visibility, indirect.half(), *rest)


def test_radiance_native_equals_reference():
    cases = [lit(3, 37), lit(1, 1, f0=0.5), lit(0, 16), lit(4, 64, roughness=(0.05, 0.2), f0=0.0)]
    check_op(shade_radiance, shade_radiance_reference, cases, SHADING_RTOL)


def test_map_native_equals_reference():
    cases = [
        mapped(6, 37),
        mapped(1, 1, points=1, f0=0.5),
        mapped(0, 16, points=0),
        mapped(4, 64, roughness=(0.05, 0.2), f0=0.0),
    ]
    check_op(shade_map, shade_map_reference, cases, SHADING_RTOL)
    check_op(in_halves(shade_map), in_halves(shade_map_reference), cases[:1], SHADING_RTOL)
    map, visibility, *rest = mapped(6, 37)
    check_op(
        shade_map, shade_map_reference, [(map, visibility.double() / 255, *rest)], SHADING_RTOL
    )


@pytest.mark.parametrize("f0", ["number", "per channel"])
def test_normals_and_metals_native_equals_reference(f0):
    for op, reference, at, case in (
        (shade_radiance, shade_radiance_reference, 1, lit),
        (shade_map, shade_map_reference, 4, mapped),
    ):
        cases = [case(3, 37), case(0, 16), case(4, 64, roughness=(0.05, 0.2))]
        behind = list(case(3, 20))
        behind[-6] = -behind[-6]  # the eye
        cases = [metals(c) for c in (*cases, tuple(behind))]
        if f0 == "number":
            cases = [(*c[:-1], 0.3) for c in cases]
        check_op(for_unit_normals(op, at), for_unit_normals(reference, at), cases, SHADING_RTOL)


def test_gradient_to_the_normal_takes_it_as_any_vector():
    """Its part along the normal, which the normalisation above drops, is the reference's too."""
    for op, reference, case in (
        (shade_radiance, shade_radiance_reference, lit(40, 64)),
        (shade_map, shade_map_reference, mapped(40, 64)),
    ):
        for full in (metals(case), (*metals(case)[:-1], 0.04)):
            normal = full[-7]
            (got,) = torch.autograd.grad(op(*full).square().sum(), normal)
            (wanted,) = torch.autograd.grad(reference(*full).square().sum(), normal)
            assert bool(((got * normal).sum(-1).abs() > 1e-3).any())
            torch.testing.assert_close(got, wanted, rtol=1e-9, atol=1e-12)


def test_every_half_is_read_right():
    """One point for each of the 65536 halves; straight up, it is all that arrives."""
    halves = torch.arange(65536).to(torch.int32).to(torch.uint16).view(torch.float16)
    up = torch.tensor([[0.0, 0.0, 1.0]])
    n = len(halves)
    indirect = halves[:, None, None].expand(n, 1, 3).contiguous()
    args = (torch.zeros(1, 3), torch.zeros(n, 1, dtype=torch.uint8), indirect, torch.arange(n))
    args = (*args, up.expand(n, 3), up.expand(n, 3), torch.ones(n, 3), torch.ones(n), up, 1.0)
    got = shade_map(*args)
    wanted = shade_map(*args[:2], indirect.float(), *args[3:])
    torch.testing.assert_close(got, wanted, rtol=0, atol=0, equal_nan=True)
    assert int(got[:, 0].isnan().sum()) == 2 * 1023
    assert int(got[:, 0].isinf().sum()) == 2


def test_fixed_light_gets_no_gradient():
    """Materials alone: the same gradients, and nothing computed for light and normal."""
    for op, case in ((shade_radiance, lit(3, 16)), (shade_map, mapped(3, 16))):
        materials = case[-5], case[-4]
        learned = torch.autograd.grad(op(*metals(case)[:-1], 0.04).sum(), materials)
        wanted = torch.autograd.grad(op(*case).sum(), materials)
        fixed = (case[0].detach(), *case[1:])
        got = torch.autograd.grad(op(*fixed).sum(), materials)
        assert all(torch.equal(a, b) for a, b in zip(got, wanted, strict=True))
        torch.testing.assert_close(got, learned, rtol=1e-12, atol=0)
    *tensors, omega, f0 = detached(lit(3, 16))
    needs = [False, False, True, True, False]
    grads = _shade_radiance.backward(*tensors, torch.tensor(f0), torch.ones(3, 3), omega, needs)
    assert [g.numel() for g in grads] == [0, 0, 9, 3, 0]
