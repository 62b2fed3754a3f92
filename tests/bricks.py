"""Sparse grids for tests: a dense one cut off far from its surface."""

import torch
from torch import Tensor

from univoxel.core.records import Bricks


def cut(sdf: Tensor, far: float, spare: int = 1) -> tuple[Tensor, Tensor, Bricks]:
    """The sdf [X, Y, Z] clamped to [-far, far], the same as a pool [64 n], and its bricks.

    Only bricks that are not clamped as a whole are stored, in no order; `spare` more are unused.
    """
    clamped = sdf.clamp(-far, far)
    shape = [-(-n // 4) for n in sdf.shape]
    padded = torch.nn.functional.pad(
        clamped[None, None],
        [v for n, s in zip(sdf.shape[::-1], shape[::-1], strict=True) for v in (0, 4 * s - n)],
        mode="replicate",
    )[0, 0]
    a, b, c = shape
    blocks = padded.view(a, 4, b, 4, c, 4).permute(0, 2, 4, 1, 3, 5).reshape(-1, 64)
    stored = (blocks.abs() < far).any(1).nonzero()[:, 0]
    stored = stored[torch.randperm(len(stored), generator=torch.Generator().manual_seed(0))]
    table = (blocks[:, 0] < 0).int()
    table[stored] = 2 + torch.arange(len(stored), dtype=torch.int32)
    place = torch.full((2 + len(stored) + spare,), -1, dtype=torch.int32)
    place[2 : 2 + len(stored)] = stored.int()
    pool = torch.full((len(place), 64), far, dtype=sdf.dtype)
    pool[1] = -far
    pool[2 : 2 + len(stored)] = blocks[stored]
    return clamped, pool.flatten(), Bricks(table.view(shape), place, tuple(sdf.shape))
