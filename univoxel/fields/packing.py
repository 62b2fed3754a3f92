"""Signed distances as a finished scene stores them: numbers near the surface, sides beyond."""

from __future__ import annotations

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

PACKED = ("rows", "values", "side")


def pack(sdf: Tensor, reach: float) -> dict[str, Tensor]:
    """What is left of distances [X, Y, Z] when beyond `reach` of the surface only the side counts.

    Args:
        reach: world units, > 0. Nodes next to one on the other side of the surface are near too.

    Returns:
        rows: [R] int32, flat numbers of the near nodes.
        values: [R] their distances.
        side: [K] int8, -1 inside and 1 outside, of every connected piece of the others, in the
            order of their first nodes.
    """
    inside = sdf.numpy() < 0
    near = sdf.abs().numpy() < reach
    for axis in range(3):
        change = np.diff(inside, axis=axis)
        low = [slice(None)] * 3
        high = list(low)
        low[axis], high[axis] = slice(0, -1), slice(1, None)
        near[tuple(low)] |= change
        near[tuple(high)] |= change
    _, first = _pieces(near)
    rows = torch.from_numpy(np.flatnonzero(near))
    side = torch.from_numpy(np.where(inside.reshape(-1)[first], -1, 1).astype(np.int8))
    return {"rows": rows.int(), "values": sdf.reshape(-1)[rows], "side": side}


def unpack(packed: dict[str, Tensor], size: tuple[int, int, int], far: float) -> Tensor:
    """Distances [X, Y, Z] from what `pack` gave: `far` or minus that where no number is kept.

    Raises:
        IndexError, ValueError: they do not belong to a grid of this size.
    """
    near = np.zeros(size, bool)
    rows = packed["rows"].long()
    near.reshape(-1)[rows.numpy()] = True
    piece, first = _pieces(near)
    side = packed["side"].float()
    if len(side) != len(first):
        raise ValueError(f"expected the sides of {len(first)} pieces of the grid, got {len(side)}")
    side = torch.cat([torch.zeros(1), side])
    sdf = far * side[torch.from_numpy(piece).long()]
    sdf.view(-1)[rows] = packed["values"].float()
    return sdf


def _pieces(near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Number of the connected piece of every node that is not near, from 1 in the order of their
    first nodes, 0 for near ones; and the flat number of each piece's first node."""
    piece = np.empty(near.shape, np.int32)
    ndimage.label(~near, output=piece)
    numbers, first = np.unique(piece, return_index=True)
    first = first[numbers > 0]
    order = np.argsort(first)
    renumber = np.zeros(int(piece.max()) + 1, np.int32)
    renumber[numbers[numbers > 0][order]] = np.arange(1, len(order) + 1)
    return renumber[piece], first[order]
