"""Independent pieces side by side: in order, and with the errors of each."""

import threading

import pytest
import torch

from univoxel.core.memmap import parallel_map


@pytest.fixture(params=[1, 2])
def threads(request):
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def test_results_keep_their_order(threads):
    assert parallel_map(lambda x: x * x, range(50)) == [x * x for x in range(50)]


def test_as_many_at_once_as_torch_has_threads(threads):
    meet = threading.Barrier(threads, timeout=20)
    parallel_map(lambda _: meet.wait(), range(2 * threads))  # one alone would wait in vain


def test_an_error_of_one_piece_is_raised(threads):
    with pytest.raises(ZeroDivisionError):
        parallel_map(lambda x: 1 / x, [1, 0, 2])
