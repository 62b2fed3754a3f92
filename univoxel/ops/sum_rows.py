"""Sums of gradients that each hold some rows of a table."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from univoxel.ops import native
from univoxel.ops.checks import check


@torch.no_grad()
def sum_rows(
    rows: Sequence[Tensor],  # n times [K]
    values: Sequence[Tensor],  # n times [K, C]
    shape: Sequence[int],
) -> tuple[Tensor, Tensor]:
    """Add up lists of rows of one table, as sparse gradients are.

    Where all lists together hold a row several times, its values are summed in the order of the
    lists. ``torch``'s sums of sparse tensors sort, on one thread.

    Args:
        rows: lists [K] int64 of numbers of rows, strictly ascending; K may differ. At least one.
        values: for each list [K, C].
        shape: of the table, D sizes; rows count its last dimension fastest. [R] for a plain one.

    Returns:
        Indices [D, U] into the table of the rows that are in any list, ascending, and their sums
        [U, C]: what ``torch.sparse_coo_tensor`` takes.

    Raises:
        TypeError, ValueError: an argument is no tensor, or of another size, dtype or device than
            above; no list; rows that do not ascend, or outside the table.
    """
    if not rows or len(rows) != len(values):
        raise ValueError(
            f"sum_rows: rows and values must be as many lists, at least one, got {len(rows)} and "
            f"{len(values)}"
        )
    arguments: dict = {}
    for i, (r, v) in enumerate(zip(rows, values, strict=True)):
        arguments[f"rows[{i}]"] = (r, f"K{i}", torch.int64)
        arguments[f"values[{i}]"] = (v, f"K{i} C")
    check("sum_rows", **arguments)
    if not shape or any(size < 1 for size in shape):
        raise ValueError(f"sum_rows: shape must be sizes of at least 1, got {list(shape)}")
    if not native.serves(values[0]):
        return sum_rows_reference(rows, values, shape)
    core, threads = native.require(), native.threads()
    lists = [native.arrays(*(t.contiguous() for t in several)) for several in (rows, values)]
    union = core.union_rows(*lists, math.prod(shape), threads)
    indices = torch.empty(len(shape), len(union), dtype=torch.int64)
    total = values[0].new_empty(len(union), values[0].shape[1])
    core.sum_rows(*lists, union, *native.arrays(total, indices), list(shape), threads)
    return indices, total


@torch.no_grad()
def sum_rows_reference(
    rows: Sequence[Tensor], values: Sequence[Tensor], shape: Sequence[int]
) -> tuple[Tensor, Tensor]:
    """The same in eager torch, over the whole table."""
    count = math.prod(shape)
    for r in rows:
        inside = not len(r) or (0 <= int(r[0]) and int(r[-1]) < count)
        if not inside or not bool((r[1:] > r[:-1]).all()):
            raise ValueError(f"sum_rows: rows must ascend in [0, {count})")
    total = values[0].new_zeros(count, values[0].shape[1])
    held = torch.zeros(count, dtype=torch.bool, device=total.device)
    for r, v in zip(rows, values, strict=True):
        total.index_add_(0, r, v)
        held[r] = True
    return held.view(*shape).nonzero().T, total[held]
