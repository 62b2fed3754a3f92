"""What the tests of extreme values share: wild numbers, and what must hold of results."""

import torch
from hypothesis import settings
from hypothesis import strategies as st

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


def same(a, b):
    """Equal numbers, NaN equal to NaN."""
    return torch.equal(torch.nan_to_num(a, 12345.0), torch.nan_to_num(b, 12345.0)) and torch.equal(
        a.isnan(), b.isnan()
    )
