"""Small networks that decode what was composited along a ray."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from univoxel import ops

FEWEST_ROWS = 2048  # for the fused op: with fewer, torch's layers one by one are done sooner


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
    return [wave for i in range(octaves) for wave in ((x * 2**i).sin(), (x * 2**i).cos())]
