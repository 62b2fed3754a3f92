"""Rows of a table: an Adam step in place, and sums of their gradients."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from univoxel.ops import native
from univoxel.ops.differentiable import check, check_numbers


def adam_rows_(
    param: Tensor,  # [R, C]
    exp_avg: Tensor,  # [R, C]
    exp_avg_sq: Tensor,  # [R, C]
    rows: Tensor,  # [K]
    grad: Tensor,  # [K, C]
    lr: float,
    beta1: float,
    beta2: float,
    eps: float,
    step: int,
) -> None:
    """Take an Adam step on the given rows; all other rows and their moments are unchanged.

        m = beta1 m + (1 - beta1) g,   v = beta2 v + (1 - beta2) g^2
        param = param - lr / (1 - beta1^step) m / (sqrt(v / (1 - beta2^step)) + eps)

    The moments of a row decay only when the row is touched, while the bias correction counts the
    steps of the whole table, as in ``torch.optim.SparseAdam``. eps is added to the corrected root,
    as in ``torch.optim.Adam``, so that it has the same effect on rows as on dense tensors;
    SparseAdam adds it to the root before the correction.

    Args:
        param: [R, C] contiguous, changed in place.
        exp_avg: [R, C] contiguous: m, changed in place.
        exp_avg_sq: [R, C] contiguous: v, at least 0, changed in place.
        rows: [K] int64 in [0, R), distinct (not checked); ascending is fastest.
        grad: [K, C] the gradient of these rows.
        lr: at least 0.
        beta1: in [0, 1).
        beta2: in [0, 1).
        eps: at least 0, in the unit of the gradient.
        step: number of steps that the table has taken, including this one; at least 1.

    Raises:
        TypeError, ValueError: an argument is no tensor, or of another size, dtype or device than
            above, or a tensor to change is not contiguous; rows outside the table; a number out
            of range.

    Source: Kingma and Ba 2015, "Adam", algorithm 1.
    """
    check(
        "adam_rows_",
        param=(param, "R C"),
        exp_avg=(exp_avg, "R C"),
        exp_avg_sq=(exp_avg_sq, "R C"),
        rows=(rows, "K", torch.int64),
        grad=(grad, "K C"),
    )
    for name, tensor in (("param", param), ("exp_avg", exp_avg), ("exp_avg_sq", exp_avg_sq)):
        if not tensor.is_contiguous():
            raise ValueError(
                f"adam_rows_: {name} must be contiguous, got strides {tensor.stride()}"
            )
    check_numbers("adam_rows_", "at least 0", lr=lr, eps=eps)
    check_numbers("adam_rows_", "in [0, 1)", beta1=beta1, beta2=beta2)
    check_numbers("adam_rows_", "at least 1", step=step)
    numbers = (float(lr), float(beta1), float(beta2), float(eps), int(step))
    if native.serves(param):
        _adam_rows(param, exp_avg, exp_avg_sq, rows.contiguous(), grad.contiguous(), *numbers)
    else:
        adam_rows_reference_(param, exp_avg, exp_avg_sq, rows, grad, *numbers)


def adam_rows_reference_(
    param: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    rows: Tensor,
    grad: Tensor,
    lr: float,
    beta1: float,
    beta2: float,
    eps: float,
    step: int,
) -> None:
    """Reference in eager PyTorch."""
    m = exp_avg[rows].lerp(grad, 1 - beta1)
    v = exp_avg_sq[rows].lerp(grad.square(), 1 - beta2)
    exp_avg[rows], exp_avg_sq[rows] = m, v
    root = (v / (1 - beta2**step)).sqrt()
    param[rows] -= lr / (1 - beta1**step) * m / (root + eps)


_adam_rows = native.Operator(
    "adam_rows_",
    lambda *inputs: native.call("adam_rows", *inputs),
    "(Tensor(a!) param, Tensor(b!) exp_avg, Tensor(c!) exp_avg_sq, Tensor rows, Tensor grad, "
    "float lr, float beta1, float beta2, float eps, int step) -> ()",
    lambda *_: None,
    mutates_args=("param", "exp_avg", "exp_avg_sq"),
)


# Sums of gradients that each hold some rows of a table.


@torch.no_grad()
def sum_rows(
    rows: Sequence[Tensor],  # n times [K]
    values: Sequence[Tensor],  # n times [K, C]
    shape: Sequence[int],
) -> tuple[Tensor, Tensor]:
    """Sum lists of rows of one table, such as sparse gradients.

    If several lists contain a row, its values are summed in the order of the lists. ``torch``, in
    contrast, sorts to sum sparse tensors, on one thread.

    Args:
        rows: at least one list [K] int64 of indices of rows, strictly ascending; K may differ.
        values: for each list [K, C].
        shape: D sizes of the table; the last dimension is fastest in rows. [R] for a plain table.

    Returns:
        Indices [D, U] into the table of the rows that are in any list, ascending, and their sums
        [U, C], as ``torch.sparse_coo_tensor`` takes them.

    Raises:
        TypeError, ValueError: an argument is no tensor, or of another size, dtype or device than
            above; no list; rows that do not ascend, or outside the table.
    """
    if not rows or len(rows) != len(values):
        raise ValueError(
            f"sum_rows: expected as many rows as values, and at least one of each, got "
            f"{len(rows)} and {len(values)}"
        )
    arguments: dict = {}
    for i, (r, v) in enumerate(zip(rows, values, strict=True)):
        arguments[f"rows[{i}]"] = (r, f"K{i}", torch.int64)
        arguments[f"values[{i}]"] = (v, f"K{i} C")
    check("sum_rows", **arguments)
    if not shape or any(size < 1 for size in shape):
        raise ValueError(f"sum_rows: every size in shape must be at least 1, got {list(shape)}")
    if not native.serves(values[0]):
        return sum_rows_reference(rows, values, shape)
    lists = [native.arrays(*(t.contiguous() for t in several)) for several in (rows, values)]
    union = native.call("union_rows", *lists, math.prod(shape))
    indices = torch.empty(len(shape), len(union), dtype=torch.int64)
    total = values[0].new_empty(len(union), values[0].shape[1])
    native.call("sum_rows", *lists, union, total, indices, list(shape))
    return indices, total


@torch.no_grad()
def sum_rows_reference(
    rows: Sequence[Tensor], values: Sequence[Tensor], shape: Sequence[int]
) -> tuple[Tensor, Tensor]:
    """Reference in eager PyTorch, over the whole table."""
    count = math.prod(shape)
    for r in rows:
        inside = not len(r) or (0 <= int(r[0]) and int(r[-1]) < count)
        if not inside or not bool((r[1:] > r[:-1]).all()):
            raise ValueError(f"sum_rows: rows must be in ascending order in [0, {count})")
    total = values[0].new_zeros(count, values[0].shape[1])
    held = torch.zeros(count, dtype=torch.bool, device=total.device)
    for r, v in zip(rows, values, strict=True):
        total.index_add_(0, r, v)
        held[r] = True
    return held.view(*shape).nonzero().T, total[held]
