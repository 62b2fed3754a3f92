"""A step's gradients, from the parts of its rays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor

from univoxel.ops import sum_rows
from univoxel.optim import rows_of


@dataclass(frozen=True)
class Part:
    """What a process does of a step, of which each rank has a part; threads share its kernels."""

    pixels: Tensor  # [N, 3] of the photographs: view, row, column
    seed: int  # of all that it draws
    share: float  # of the step's rays


@dataclass(frozen=True)
class Descent:
    """What a part comes to."""

    terms: dict[str, Tensor]  # of the loss, weighted
    gradients: Sequence[Tensor | None]  # of the loss, times the part's share


def parts_of(pixels: Tensor, rays: int, count: int) -> list[Part]:
    """Draw a step's rays among pixels [P, 3], with replacement: `count` parts, or one of few."""
    drawn = pixels[torch.randint(len(pixels), (rays,))]
    seeds = torch.randint(2**62, (count,)).tolist()
    chunks = drawn.tensor_split(count) if rays >= count else [drawn]
    return [
        Part(chunk, seed, len(chunk) / rays) for chunk, seed in zip(chunks, seeds, strict=False)
    ]


def descent(terms: dict[str, Tensor], share: float, inputs: Sequence[Tensor]) -> Descent:
    """Differentiate a part's loss by each of the inputs; None where it does not depend on it."""
    loss = share * torch.stack(list(terms.values())).sum()
    gradients = torch.autograd.grad(loss, inputs, allow_unused=True)
    return Descent({name: term.detach() for name, term in terms.items()}, gradients)


def summed_terms(parts: Sequence[Part], descents: Sequence[Descent]) -> dict[str, Tensor]:
    """The loss's terms over all parts, each the mean of theirs."""
    total: dict[str, Tensor] = {}
    for part, descent in zip(parts, descents, strict=True):
        for name, term in descent.terms.items():
            total[name] = total.get(name, torch.zeros(())) + part.share * term
    return total


def total(gradients: Sequence[Tensor | None]) -> Tensor | None:
    """The sum of gradients of one parameter, all sparse or all dense."""
    given = [g for g in gradients if g is not None]
    if len(given) < 2:
        return given[0] if given else None
    if not given[0].is_sparse:
        return reduce(torch.add, given)
    first = given[0]
    dims, shape = first.sparse_dim(), first.shape
    channels = shape[dims:].numel()
    indices, values = sum_rows(
        [rows_of(g) for g in given],
        [g._values().reshape(len(g._values()), channels) for g in given],
        shape[:dims],
    )
    return torch.sparse_coo_tensor(
        indices,
        values.view(-1, *shape[dims:]),
        shape,
        is_coalesced=True,
        check_invariants=False,  # ascending and inside by construction
    )
