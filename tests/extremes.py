"""What the tests of extreme values share: wild numbers, and what must hold of results."""

import torch
from hypothesis import settings
from hypothesis import strategies as st

from univoxel import sphere

few = settings(max_examples=40, deadline=None, derandomize=True)

REACH = 1e36  # of a float32 result: sums of some tens of these stay below 3.4e38
WILD = (0.0, -0.0, 1e-45, -1e-40, 1.2e-38, 1e-7, 0.5, 1.0, -1.0, 1e4, 1e30, -1e30)
seeds = st.integers(0, 2**31)
channels = st.sampled_from([0, 1, 3, 12, 17])


def pick(generator, values, *size):
    """Numbers drawn from a list, and as many from a normal distribution."""
    values = torch.tensor(values, dtype=torch.float64)
    drawn = values[torch.randint(len(values), size, generator=generator)]
    usual = torch.randn(size, generator=generator, dtype=torch.float64)
    return torch.where(torch.rand(size, generator=generator) < 0.5, drawn, usual).float()


def run(op, arguments, dtype=torch.float32):
    """Outputs, then gradients of their sum to every floating tensor that asks for one."""
    arguments = [
        a.detach().to(dtype).requires_grad_(a.requires_grad)
        if isinstance(a, torch.Tensor) and a.is_floating_point()
        else a
        for a in arguments
    ]
    out = op(*arguments)
    out = [out] if isinstance(out, torch.Tensor) else list(out)
    leaves = [a for a in arguments if isinstance(a, torch.Tensor) and a.requires_grad]
    through = [o for o in out if o.requires_grad]
    grads = torch.autograd.grad(through, leaves, [torch.ones_like(o) for o in through])
    return [*(o.detach() for o in out), *(g.to_dense() if g.is_sparse else g for g in grads)]


def check_finite(op, reference, arguments):
    for got, want in zip(
        run(op, arguments),
        run(reference, arguments, torch.float64),
        strict=True,
    ):
        assert got.shape == want.shape
        lost = want.isfinite() & (want.abs() < REACH) & ~got.isfinite()
        assert not lost.any(), f"{got[lost][:4]}, in float64 {want[lost][:4]}"


def same(a, b):
    """Equal numbers, NaN equal to NaN."""
    return torch.equal(torch.nan_to_num(a, 12345.0), torch.nan_to_num(b, 12345.0)) and torch.equal(
        a.isnan(), b.isnan()
    )


def shading(seed, n, k):
    g = torch.Generator().manual_seed(seed)

    def unit(*size):
        v = torch.nn.functional.normalize(torch.randn(*size, 3, generator=g), dim=-1)
        poles = torch.tensor([[0.0, 0, 1], [0, 0, -1], [0, -0.0, -0.0], [1, 0, 0], [1e-20, 0, 1]])
        chosen = poles[torch.randint(len(poles), size, generator=g)]
        return torch.where(torch.rand(*size, 1, generator=g) < 0.4, chosen, v)

    normal = unit(n)
    towards = torch.tensor([1.0, -1.0])[torch.randint(2, (n, 1), generator=g)]
    wo = torch.where(torch.rand(n, 1, generator=g) < 0.3, normal * towards, unit(n))
    sharpness = pick(g, (0.0, 1e-45, 1e-3, 30.0, 1e6, 1e30), n, k).abs()
    amplitude = pick(g, (0.0, 1e-45, 1.0, 1e6), n, k, 3).abs()
    albedo = pick(g, (0.0, 1.0, 1e-45), n, 3).clamp(0, 1)
    roughness = pick(g, (0.0, 1.0, 1e-45, 0.03), n).clamp(0, 1)
    parameters = (unit(n, k), sharpness, amplitude, normal, wo, albedo, roughness)
    directions = sphere.fibonacci_hemisphere(32)
    rotation = pick(g, (0.0, 6.2831853, -1e4), n)
    return [p.requires_grad_() for p in parameters] + [directions, rotation]
