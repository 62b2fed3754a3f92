"""Shading and lobes of light: closed forms, extremes, and ops that stand for one another."""

import math

import torch
from op_cases import CASES, doubled, fresh, function, normal, under_radiance

from univoxel import brdf
from univoxel.ops import (
    decode_lobes,
    decode_lobes_reference,
    shade_map,
    shade_radiance,
    shade_sg,
    specular_response,
    use_backend,
)
from univoxel.ops.shade import _shade_radiance


def test_the_exponential_of_a_lobe_is_accurate():
    """One direction straight up and lobes straight down: rgb is exp(-2 s) times a constant."""
    s = torch.linspace(0, 40, 5001)  # 2 s is exact; exp(-80) / 300 is still a normal number
    n = len(s)
    up = torch.tensor([0.0, 0, 1]).expand(n, 3)
    one = torch.ones(n, 1, 3)
    args = (one, up, up, torch.zeros(n, 3), torch.ones(n), up[:1], torch.zeros(n))
    rgb = shade_sg(-up[:, None], s[:, None], *args)[:, 0].double()
    relative = rgb / rgb[0] / torch.exp(-2 * s.double()) - 1
    # 2 ulp for the power of two, half an ulp for each of the few products around it; and sharpness
    # times log2 e is rounded, which is as if sharpness were off by less than an ulp.
    assert bool((relative.abs() < 4 * 2**-23 + 2 * s.double() * 2**-23).all())


def test_the_specular_response_is_the_shading_of_black_points():
    """Its rows times a map; and they are 0 below the horizon."""
    given = doubled(under_radiance(40, 96))
    rays = {k: given[k] for k in ("normal", "wo", "roughness", "directions", "solid_angle")}
    rows, map = specular_response(**rays), given["radiance"][0]
    light, black = map.expand(40, -1, -1), torch.zeros(40, 3).double()
    wanted = shade_radiance(light, albedo=black, f0=brdf.F0, **rays)
    torch.testing.assert_close(rows @ map, wanted)
    below = rays["normal"] @ rays["directions"].T < -1e-6
    assert 0.3 < below.double().mean() < 0.7
    assert (rows[below] == 0).all()


def test_gradient_to_the_normal_takes_it_as_any_vector():
    """Its part along the normal, which unit normals leave out, is the reference's too."""
    for case in ("shade_radiance", "shade_map", "shade_radiance of dielectrics"):
        given, _ = fresh(case, doubled(CASES[case](40, directions=64)))
        normal = given["normal"]
        (got,) = torch.autograd.grad(function(case)(**given).square().sum(), normal)
        with use_backend("reference"):
            (wanted,) = torch.autograd.grad(function(case)(**given).square().sum(), normal)
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
    for case, light in (("shade_radiance", "radiance"), ("shade_map", "map")):
        learned, _ = fresh(case, doubled(CASES[case](3)) | {"f0": 0.04})
        found = []
        for fixed in ([], [light], ["normal"], [light, "normal"]):
            given = learned | {name: learned[name].detach() for name in fixed}
            materials = given["albedo"], given["roughness"]
            found.append(torch.autograd.grad(function(case)(**given).sum(), materials))
        for other in found[1:]:
            torch.testing.assert_close(other, found[0], rtol=1e-12, atol=0)
    given = under_radiance(3) | {"f0": torch.tensor(0.04)}
    omega = given.pop("solid_angle")
    tensors = (given[k] for k in ("radiance", "normal", "wo", "albedo", "roughness", "directions"))
    needs = [False, False, True, True, False]
    grads = _shade_radiance.backward(*tensors, given["f0"], torch.ones(3, 3), omega, needs)
    assert [g.numel() for g in grads] == [0, 0, 9, 3, 0]


LOW, HIGH = 0.1, 30.0


def test_closed_forms_of_lobes():
    numbers = torch.tensor([[0.0, -3.0, 4.0, 0.0, 0.0, math.log(math.e - 1), -40.0]])
    axis, sharpness, amplitude = decode_lobes(numbers, LOW, HIGH)
    torch.testing.assert_close(axis, torch.tensor([[0.0, -0.6, 0.8]]))
    torch.testing.assert_close(sharpness, torch.tensor([LOW + HIGH / 2]))
    wanted = torch.tensor([[math.log(2), 1.0, math.exp(-40)]])
    torch.testing.assert_close(amplitude, wanted, rtol=1e-5, atol=0)
    numbers = torch.full((1, 7), math.nan)
    for x in decode_lobes(numbers, LOW, HIGH):
        assert x.isnan().all()


def test_short_vectors_are_scaled():
    """The gradient to a vector below the shortest does not turn it: it is 1e6 times the axis's."""
    numbers = torch.zeros(1, 7, dtype=torch.float64)
    numbers[0, :3] = torch.tensor([3e-8, 4e-8, 0.0])
    numbers.requires_grad_()
    axis, *_ = decode_lobes(numbers, LOW, HIGH)
    torch.testing.assert_close(axis, 1e6 * numbers[:, :3])
    (grad,) = torch.autograd.grad(axis @ axis.new_tensor([1.0, 2.0, 3.0]), numbers)
    torch.testing.assert_close(grad[0, :3], grad.new_tensor([1e6, 2e6, 3e6]))


def test_a_gradient_of_some_outputs():
    numbers = normal(6, 7).double().requires_grad_()
    for k in range(3):
        got, wanted = (
            torch.autograd.grad(op(numbers, LOW, HIGH)[k].square().sum(), numbers)[0]
            for op in (decode_lobes, decode_lobes_reference)
        )
        torch.testing.assert_close(got, wanted)
