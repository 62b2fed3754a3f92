"""The same bits on any number of threads, with more work than one chunk; what other files of this
folder do not hold already."""

import pytest
import torch

from univoxel import ops, sphere

N = 3000


def normal(*shape, seed=0, grad=True):
    x = torch.randn(*shape, generator=torch.Generator().manual_seed(seed))
    return x.requires_grad_(grad)


def unit(*shape, seed=0, grad=True):
    x = torch.nn.functional.normalize(normal(*shape, 3, seed=seed, grad=False), dim=-1)
    return x.requires_grad_(grad)


def composite():
    alpha = torch.rand(3 * N, generator=torch.Generator().manual_seed(1)).requires_grad_()
    value = normal(3 * N, 12)
    return ops.composite(alpha, value, torch.arange(0, 3 * N + 1, 3)), [alpha, value]


def shade_sg():
    leaves = [unit(N, 4), normal(N, 4).abs().detach().requires_grad_(), normal(N, 4, 3), unit(N),
              unit(N, seed=1), normal(N, 3), torch.full((N,), 0.4).requires_grad_()]  # fmt: skip
    f0 = normal(N, 3, seed=1)
    rgb = ops.shade_sg(*leaves, sphere.fibonacci_hemisphere(16), torch.zeros(N), f0)
    return rgb, [*leaves, f0]


def decode_lobes():
    numbers = normal(6 * N, 7)
    return ops.decode_lobes(numbers, 0.1, 30.0), [numbers]


def shade_radiance():
    radiance, albedo, f0 = normal(N, 16, 3), normal(N, 3), normal(N, 3, seed=1)
    roughness = torch.full((N,), 0.4).requires_grad_()
    n, wo = unit(N), unit(N, seed=1, grad=False)
    rgb = ops.shade_radiance(
        radiance, n, wo, albedo, roughness, sphere.fibonacci_sphere(16), 4 * torch.pi / 16, f0
    )
    return rgb, [radiance, n, albedo, roughness, f0]


def specular_response():
    n, wo = unit(N, grad=False), unit(N, seed=1, grad=False)
    rows = ops.specular_response(n, wo, torch.full((N,), 0.4), sphere.fibonacci_sphere(16), 0.1)
    return rows, []


def march():
    x = torch.linspace(-1, 1, 40)
    sdf = torch.stack(torch.meshgrid(x, x, x, indexing="ij"), -1).norm(dim=-1) - 0.6
    origin = 2 * unit(N, grad=False)
    direction = torch.nn.functional.normalize(0.5 * unit(N, seed=1, grad=False) - origin, dim=1)
    least = ops.brick_minimum(sdf)
    samples = ops.march(
        sdf, least, origin, direction, torch.full((N,), 0.5), (-1.0,) * 3, 2 / 39,
        step=2 / 39, inv_s=40.0,
    )  # fmt: skip
    return (least, samples.t, samples.connected, samples.offsets), []


def patch_correlation():
    g = torch.Generator().manual_seed(2)
    pictures = torch.rand(3, 30, 40, generator=g)
    views = torch.randint(0, 3, (N, 2), generator=g)
    turn, position = normal(3, 3, 4, grad=False), normal(N, 3)
    plane = [position, unit(N, seed=3)]
    rays = normal(N, 3, 3, seed=4, grad=False)
    own = torch.rand(N, 9, generator=g)
    origin = normal(N, 3, seed=5, grad=False)
    return ops.patch_correlation(pictures, turn, origin, rays, own, views, *plane), plane


@pytest.mark.parametrize(
    "op",
    [
        *(composite, shade_sg, decode_lobes, shade_radiance, specular_response, march),
        patch_correlation,
    ],
)
def test_same_bits(op):
    before, runs = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            out, leaves = op()
            out = [out] if isinstance(out, torch.Tensor) else list(out)
            through = [o for o in out if o.requires_grad]
            seeds = [torch.cos(torch.arange(o.numel())).view(o.shape) for o in through]
            grads = torch.autograd.grad(through, leaves, seeds) if leaves else ()
            runs.append([*out, *grads])
    finally:
        torch.set_num_threads(before)
    assert runs[0][0].numel() >= 100
    for other in runs[1:]:
        for a, b in zip(runs[0], other, strict=True):
            assert torch.equal(a, b)
