"""Gradients of a step, summed over the ranks of a training."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from univoxel import ranks
from univoxel.ops import sum_rows
from univoxel.optim import rows_of


@dataclass
class Traffic:
    """What exchanges came to so far."""

    steps: int = 0
    sent: int = 0  # bytes, by all ranks together
    touched: int = 0  # bytes of the summed gradients: numbers of touched rows, values, networks

    def as_json(self) -> dict[str, float]:
        """Per step, with the number of ranks."""
        steps = max(self.steps, 1)
        each = {"sent": self.sent / steps, "touched": self.touched / steps}
        return {"count": ranks.count(), "steps": self.steps} | each


TRAFFIC = Traffic()  # of this process


def summed_over_ranks_(parameters: Sequence[Tensor], terms: dict[str, Tensor]) -> dict[str, Tensor]:
    """Give every parameter the sum of its gradients on all ranks; return the sums of the terms.

    Of a table only touched rows travel: their numbers as int32 and their values. All ranks end with
    the same bits. A rank that has no gradient of a parameter adds nothing to it.

    Raises:
        RuntimeError: parameters differ in their sizes from rank to rank.
    """
    if ranks.count() == 1:
        return terms
    before = ranks.sent_bytes()
    gradients = [None if p.grad is None else _ascending(p.grad) for p in parameters]
    header = {
        "terms": {name: term.item() for name, term in terms.items()},
        "shapes": [list(p.shape) for p in parameters],
        "layouts": [_layout(g) for g in gradients],
    }
    tables = [g for g in gradients if g is not None and g.is_sparse]
    packed = [part for g in tables for part in (rows_of(g).int(), g._values().view(torch.int32))]
    told = ranks.messages(torch.cat([_encoded(header), *(part.flatten() for part in packed)]))
    headers, bodies = zip(*map(_decoded, told), strict=True)
    if any(h["shapes"] != headers[0]["shapes"] for h in headers):
        raise RuntimeError("ranks have come apart: their scenes differ in size")
    layouts = [h["layouts"] for h in headers]
    touched = _sum_tables_(parameters, layouts, bodies) + _sum_dense_(parameters, layouts)
    TRAFFIC.steps += 1
    TRAFFIC.sent += ranks.sent_bytes() - before
    TRAFFIC.touched += touched
    return _summed([h["terms"] for h in headers])


def _ascending(grad: Tensor) -> Tensor:
    """A gradient whose rows, if it is sparse, ascend."""
    if not grad.is_sparse:
        return grad
    rows = rows_of(grad)
    return grad if bool((rows[1:] > rows[:-1]).all()) else grad.coalesce()


# Of a gradient: None: there is none; [-1]: dense; else number of rows, and sparse dimensions
Layout = list[int] | None


def _layout(grad: Tensor | None) -> Layout:
    if grad is None:
        return None
    return [grad._nnz(), grad.sparse_dim()] if grad.is_sparse else [-1]


def _encoded(header: dict[str, Any]) -> Tensor:
    """JSON as int32 [N], its length before it."""
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    numbers = torch.frombuffer(bytearray(text), dtype=torch.int32)
    return torch.cat([torch.tensor([len(numbers)], dtype=torch.int32), numbers])


def _decoded(message: Tensor) -> tuple[dict[str, Any], Tensor]:
    """A header, and what comes after it."""
    end = 1 + int(message[0])
    return json.loads(message[1:end].numpy().tobytes()), message[end:]


def _sum_tables_(
    parameters: Sequence[Tensor], layouts: Sequence[list[Layout]], bodies: Sequence[Tensor]
) -> int:
    """Set gradients of tables to the sums of what ranks have told of them; return their bytes."""
    touched, at = 0, [0] * len(bodies)
    for i, parameter in enumerate(parameters):
        shape, dims = parameter.shape, 0
        numbers, values = [], []
        for k, body in enumerate(bodies):
            match layouts[k][i]:
                case [count, dims]:
                    channels = shape[dims:].numel()
                    end = at[k] + count * (1 + channels)
                    number, value = body[at[k] : end].split([count, count * channels])
                    numbers.append(number.long())
                    values.append(value.view(torch.float32).view(count, channels))
                    at[k] = end
        if not numbers:
            continue
        indices, total = sum_rows(numbers, values, shape[:dims])
        parameter.grad = torch.sparse_coo_tensor(
            indices,
            total.view(-1, *shape[dims:]),
            shape,
            is_coalesced=True,
            check_invariants=False,  # ascending and inside by construction
        )
        touched += 4 * total.shape[0] * (1 + total.shape[1])
    return touched


def _sum_dense_(parameters: Sequence[Tensor], layouts: Sequence[list[Layout]]) -> int:
    """The same of gradients that are dense on any rank."""
    dense = [p for i, p in enumerate(parameters) if any(of_rank[i] == [-1] for of_rank in layouts)]
    if not dense:
        return 0
    parts = [torch.zeros_like(p) if p.grad is None else p.grad for p in dense]
    total = ranks.total(torch.cat([part.flatten() for part in parts]))
    for parameter, summed in zip(dense, total.split([p.numel() for p in dense]), strict=True):
        parameter.grad = summed.view_as(parameter)
    return total.nbytes


def _summed(terms: Sequence[dict[str, float]]) -> dict[str, Tensor]:
    """Terms by name, added up in the order of ranks."""
    total: dict[str, float] = {}
    for of_rank in terms:
        for name, term in of_rank.items():
            total[name] = total.get(name, 0.0) + term
    return {name: torch.tensor(term) for name, term in total.items()}
