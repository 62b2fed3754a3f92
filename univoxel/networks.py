"""Small networks that decode what was composited along a ray, and what they read of directions."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from univoxel import ops

FEWEST_ROWS = 256  # for the fused op: with fewer, torch's layers one by one are done sooner


class MLP(nn.Sequential):
    """Linear layers with ReLU between them; many rows are evaluated as one op.

    Args:
        sizes: numbers of inputs, of each hidden layer's units, of outputs; each at least 1.
        generator: draws the first weights, He-uniform with biases 0; without one they are drawn as
            torch.nn.Linear draws its own.
    """

    def __init__(self, sizes: Sequence[int], generator: torch.Generator | None = None) -> None:
        layers: list[nn.Module] = []
        for i, o in pairwise(sizes):
            layers += [nn.Linear(i, o), nn.ReLU()]
        super().__init__(*layers[:-1])
        if generator is None:
            return
        for layer in self.linear:
            nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu", generator=generator)
            nn.init.zeros_(layer.bias)

    @property
    def linear(self) -> list[nn.Linear]:
        """The layers that hold parameters."""
        return [layer for layer in self if isinstance(layer, nn.Linear)]

    def forward(self, x: Tensor) -> Tensor:
        """[N, sizes[0]] -> [N, sizes[-1]]."""
        if len(x) < FEWEST_ROWS:
            return super().forward(x)
        linear = self.linear
        return ops.mlp(x, [layer.weight for layer in linear], [layer.bias for layer in linear])


def waves(x: Tensor, octaves: int) -> list[Tensor]:
    """Sines and cosines of x, 2 x, 4 x and so on: 2 * octaves tensors as x.

    Networks of low dimension learn detail from them. Source: Mildenhall et al. 2020, eq. 4.
    """
    higher = [x * 2**i if i else x for i in range(octaves)]
    return [wave for y in higher for wave in (y.sin(), y.cos())]


class DirectionTable(nn.Module):
    """Learned features [N, 2 L] of unit directions [N, 3], from lattices of L sizes: 29 degrees at
    the coarsest, half as much at each of the next.

    Networks of few inputs are smooth over directions; what a polished surface mirrors is not, and
    is the same for all of its points. Zero at first. Only the coarsest levels pass gradients on to
    the direction, and so to the normal that mirrors it: through the others it would feel what is a
    few degrees around, which is noise to a normal that is off by more.

    Source: Mueller et al. 2022, "Instant Neural Graphics Primitives", on the sphere.
    """

    coarsest: float = 0.5  # side of a cell, of a box of 2 around the sphere
    rows = 2**14  # of a level; of those from the fourth on several nodes share one
    per_level = 2
    felt = 3  # levels that the direction gets gradients from

    def __init__(self, levels: int) -> None:
        super().__init__()
        self.table: nn.Parameter = nn.Parameter(torch.zeros(levels * self.rows, self.per_level))

    @property
    def levels(self) -> int:
        return len(self.table) // self.rows

    @property
    def channels(self) -> int:
        return self.per_level * self.levels

    @classmethod
    def rows_used(cls, level: int) -> int:
        """Rows of a level, from 0 on, that any direction can meet, at most."""
        return min(cls.rows, round(2 ** (level + 1) / cls.coarsest + 1) ** 3)

    def forward(self, direction: Tensor) -> Tensor:
        sizes = [self.coarsest / 2**k for k in range(self.levels)]
        if not sizes:
            return direction[:, :0]
        box = (-1.0,) * 3, (1.0,) * 3
        return ops.encode_hash(self.table, direction, *box, sizes, felt=self.felt)
