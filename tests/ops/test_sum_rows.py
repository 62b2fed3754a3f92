"""Sums of gradients that each hold some rows."""

import math

import pytest
import torch

from univoxel.ops import sum_rows, sum_rows_reference

TABLE = 100_003  # no multiple of 64, and several chunks


def lists(counts, channels=2, dtype=torch.float64, seed=0):
    g = torch.Generator().manual_seed(seed)
    rows = [torch.randperm(TABLE, generator=g)[:n].sort().values for n in counts]
    return rows, [torch.randn(n, channels, generator=g, dtype=dtype) for n in counts]


@pytest.mark.parametrize("counts", [(40_000, 7000, 30_000), (1,), (0, 5), (0,), (TABLE, TABLE)])
@pytest.mark.parametrize("channels", [1, 2, 12, 0])
@pytest.mark.parametrize("shape", [(TABLE,), (7, 13, 1097)])
def test_native_equals_reference(counts, channels, shape):
    rows, values = lists([min(n, math.prod(shape)) for n in counts], channels)
    rows = [r[r < math.prod(shape)] for r in rows]
    values = [v[: len(r)] for r, v in zip(rows, values, strict=True)]
    got, wanted = sum_rows(rows, values, shape), sum_rows_reference(rows, values, shape)
    for a, b in zip(got, wanted, strict=True):
        torch.testing.assert_close(a, b)


def test_it_is_the_sum_of_sparse_tensors():
    rows, values = lists((3000, 50_000))
    parts = [
        torch.sparse_coo_tensor(r[None], v, (TABLE, 2), check_invariants=True)
        for r, v in zip(rows, values, strict=True)
    ]
    whole = (parts[0] + parts[1]).coalesce()
    row, total = sum_rows(rows, values, [TABLE])
    assert torch.equal(row, whole.indices())
    torch.testing.assert_close(total, whole.values())


@pytest.mark.parametrize("row", [[5, 5], [5, 4], [-1, 3], [3, 10]])
def test_the_reference_refuses_rows_that_do_not_ascend_in_the_table(row):
    with pytest.raises(ValueError, match=r"rows must be in ascending order in \[0, 10\)"):
        sum_rows_reference([torch.tensor(row)], [torch.ones(2, 3)], [10])
