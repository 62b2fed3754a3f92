"""Tensors that nobody should give, several threads at once, and forks: refused, or as ever.

Extremes of values are in test_extremes*.py, arrays that the extension must not convert in
test_bindings.py.
"""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from univoxel import ops, sphere
from univoxel.ops import native

pytestmark = pytest.mark.skipif(native.core is None, reason="without the extension")
N = 400


def numbers(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def units(*shape, seed=0):
    return torch.nn.functional.normalize(numbers(*shape, 3, seed=seed) - 0.5, dim=-1)


def composite(alpha, value):
    return ops.composite(alpha, value, torch.arange(0, N + 1, 4))


def mlp(x, w0, w1):
    return ops.mlp(x, [w0, w1], [torch.zeros(8), torch.zeros(3)])


def shade_radiance(radiance, n, wo, albedo, f0):
    roughness, wi = torch.full((N,), 0.4), sphere.fibonacci_sphere(16)
    return ops.shade_radiance(radiance, n, wo.detach(), albedo, roughness, wi, 0.8, f0)


def sample_dense(values, points):
    return ops.sample_dense(values[..., 0], values[..., 1:], points, (-1.0,) * 3, 0.25)


CASES = {
    composite: [numbers(N), numbers(N, 5)],
    mlp: [numbers(N, 6), numbers(8, 6), numbers(3, 8)],
    shade_radiance: [numbers(N, 16, 3), units(N), units(N, seed=1), numbers(N, 3), numbers(N, 3)],
    sample_dense: [numbers(9, 9, 9, 4), 2 * numbers(N, 3) - 1],
}


def flat(out):
    return [out] if isinstance(out, torch.Tensor) else [o for o in out if o is not None]


def results(op, arguments):
    """Outputs and gradients."""
    leaves = [a.detach().requires_grad_() for a in arguments]
    out = flat(op(*leaves))
    total = sum((o * torch.cos(torch.arange(o.numel())).view(o.shape)).sum() for o in out)
    grads = torch.autograd.grad(total, leaves, allow_unused=True)
    return [o.detach() for o in out] + [g for g in grads if g is not None]


def scattered(tensor):
    """The same numbers in a larger storage, behind an offset, with strides of their own."""
    room = torch.full((*(2 * n + 3 for n in reversed(tensor.shape)),), torch.nan)
    view = room[tuple(slice(3, None, 2) for _ in tensor.shape)].permute(*range(tensor.dim()))
    view = view.permute(*reversed(range(tensor.dim())))
    return view.copy_(tensor)


@pytest.mark.parametrize("op", CASES, ids=lambda op: op.__name__)
def test_strides_and_offsets_of_storage(op):
    wanted = results(op, CASES[op])
    given = [scattered(a) for a in CASES[op]]
    assert not any(a.is_contiguous() for a in given)
    for a, b in zip(results(op, given), wanted, strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("op", CASES, ids=lambda op: op.__name__)
@pytest.mark.parametrize("dtype", [torch.int64, torch.bool, torch.complex64])
def test_dtypes_that_are_no_numbers_of_ours(op, dtype):
    for i, argument in enumerate(CASES[op]):
        given = [*CASES[op][:i], argument.to(dtype), *CASES[op][i + 1 :]]
        with pytest.raises((ValueError, TypeError)):
            op(*given)


@pytest.mark.parametrize("op", CASES, ids=lambda op: op.__name__)
def test_rows_that_are_missing(op):
    for i, argument in enumerate(CASES[op]):
        for wrong in (argument[:-1], argument[0], argument[None]):
            given = [*CASES[op][:i], wrong, *CASES[op][i + 1 :]]
            if op is sample_dense and wrong.dim() == argument.dim() and wrong.numel():
                continue  # another grid, or fewer points: as good
            if op is mlp and i == 0 and wrong.shape == argument[:-1].shape:
                continue
            with pytest.raises((ValueError, TypeError, IndexError)):
                op(*given)


@pytest.mark.parametrize(
    "offsets",
    [[-4, N], [0, -1, N], [0, N + 1], [0, 2**62, N], [4, N], [0, 8, 4, N], [0], [], [-(2**63), N]],
)
def test_offsets_that_lead_elsewhere(offsets):
    alpha, value = CASES[composite]
    with pytest.raises(ValueError, match="composite: offsets must"):
        ops.composite(alpha, value, torch.tensor(offsets, dtype=torch.int64))


@pytest.mark.parametrize("row", [-1, 27, 2**40, -(2**63)])
def test_rows_that_lie_elsewhere(row):
    grid = numbers(3, 3, 3, 2)
    with pytest.raises(ValueError, match="rows must lie in"):
        ops.smooth_rows_(grid, torch.tensor([row]), 0.1, 1)


def test_counts_beyond_all_memory():
    """Views of one number claim sizes that no kernel may believe before it has them."""
    huge = torch.zeros(1).expand(2**40)
    with pytest.raises((ValueError, RuntimeError, MemoryError)):
        ops.composite(huge, torch.zeros(1, 1).expand(2**40, 1), torch.tensor([0, 2**40]))


@pytest.mark.parametrize("op", CASES, ids=lambda op: op.__name__)
def test_nan_everywhere_ends(op):
    for bad in (torch.nan, torch.inf, -torch.inf):
        out = flat(op(*(torch.full_like(a, bad) for a in CASES[op])))
        assert all(o.shape[0] for o in out)


def test_threads_of_python_at_once():
    """Kernels run without Python's lock; none may share what it works on with another."""
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        wanted = {op: results(op, arguments) for op, arguments in CASES.items()}
        with ThreadPoolExecutor(4) as pool:
            jobs = [(op, pool.submit(results, op, CASES[op])) for _ in range(8) for op in CASES]
            for op, job in jobs:
                for a, b in zip(job.result(timeout=120), wanted[op], strict=True):
                    assert torch.equal(a, b), op.__name__
    finally:
        torch.set_num_threads(before)


FORK = """
import os, torch
from univoxel import ops
torch.set_num_threads(2)
n = 20_000
g = torch.Generator().manual_seed(0)
given = torch.rand(3 * n, generator=g), torch.rand(3 * n, 12, generator=g)
given += (torch.arange(0, 3 * n + 1, 3),)
wanted = ops.composite(*given)[0].numpy().tobytes()
child = os.fork()
if not child:
    os._exit(0 if ops.composite(*given)[0].numpy().tobytes() == wanted else 3)
_, status = os.waitpid(child, 0)
assert os.waitstatus_to_exitcode(status) == 0, status
assert ops.composite(*given)[0].numpy().tobytes() == wanted
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="without fork")
@pytest.mark.skipif("tsan" in os.environ.get("LD_PRELOAD", ""), reason="it refuses such forks")
def test_a_fork_of_a_process_that_has_used_threads():
    """GNU's OpenMP waited for ever for the threads that a fork does not have."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", FORK],
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 0, done.stderr
