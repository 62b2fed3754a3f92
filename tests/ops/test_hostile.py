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
from op_cases import CASES, DIFFERENTIABLE, flat, fresh, function, results

from univoxel import ops
from univoxel.ops import native

pytestmark = pytest.mark.skipif(native.core is None, reason="without the extension")


def test_counts_beyond_all_memory():
    """Views of one number claim sizes that no kernel may believe before it has them."""
    huge = torch.zeros(1).expand(2**40)
    with pytest.raises((ValueError, RuntimeError, MemoryError)):
        ops.composite(huge, torch.zeros(1, 1).expand(2**40, 1), torch.tensor([0, 2**40]))


@pytest.mark.parametrize("case", DIFFERENTIABLE)
@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
def test_numbers_that_are_none_end(case, bad):
    arguments, leaves = fresh(case, CASES[case](100))
    with torch.no_grad():
        for leaf in leaves:
            leaf.fill_(bad)
    for out in flat(function(case)(**arguments)):
        assert len(out)


def test_threads_of_python_at_once():
    """Kernels run without Python's lock; none may share what it works on with another."""
    before = torch.get_num_threads()
    given = {case: CASES[case](400) for case in DIFFERENTIABLE}
    work = 8 * list(given.items())
    try:
        torch.set_num_threads(2)
        wanted = {case: results(case, arguments) for case, arguments in given.items()}
        with ThreadPoolExecutor(4) as pool:
            jobs = [(case, pool.submit(results, case, arguments)) for case, arguments in work]
            for case, job in jobs:
                for a, b in zip(job.result(timeout=120), wanted[case], strict=True):
                    assert torch.equal(a, b), case
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
