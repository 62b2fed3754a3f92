"""Small networks: the op, and modules that decode features composited along a ray."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from univoxel.ops import native
from univoxel.ops.differentiable import check, differentiable
from univoxel.ops.hash_grid import encode_hash


def mlp(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> Tensor:
    """Decode rows by linear layers with ReLU between them.

        h_0 = x,   h_{l+1} = max(h_l W_l^T + b_l, 0),   without the maximum in the last layer

    Args:
        x: [N, A] any number of rows.
        weights: one [out, in] per layer, as in torch.nn.Linear; every size at least 1.
        biases: one [out] per layer.

    Returns:
        [N, Z], Z the last layer's `out`.

    Raises:
        TypeError, ValueError: an argument is no tensor, or of another size, dtype or device than
            above; there is no layer, or weights and biases differ in number.

    Differentiable in: x, weights, biases; at 0 the derivative of ReLU is 0. Second order raises.
    """
    weights, biases = list(weights), list(biases)
    if not weights or len(weights) != len(biases):
        raise ValueError(
            f"mlp: expected as many weights as biases, and at least one of each, got "
            f"{len(weights)} weights and {len(biases)} biases"
        )
    layers: dict[str, tuple[Tensor, str]] = {}
    for i, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        layers[f"weights[{i}]"] = (weight, f"H{i + 1} H{i}")
        layers[f"biases[{i}]"] = (bias, f"H{i + 1}")
    sizes = check("mlp", x=(x, "N H0"), **layers)
    empty = [name for name, size in sizes.items() if name != "N" and size < 1]
    if empty:
        raise ValueError(f"mlp: every layer must be at least 1 wide, got {empty[0]}=0")
    if native.serves(x):
        return _mlp(
            x.contiguous(), [w.contiguous() for w in weights], [b.contiguous() for b in biases]
        )
    return mlp_reference(x, weights, biases)


def mlp_reference(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> Tensor:
    """Reference in eager PyTorch."""
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        x = torch.relu(torch.nn.functional.linear(x, weight, bias))
    return torch.nn.functional.linear(x, weights[-1], biases[-1])


def _forward(tensors: Sequence, _: Sequence, outputs: Sequence[Tensor]) -> None:
    x, weights, biases = tensors
    layers = native.arrays(*weights), native.arrays(*biases)
    native.call("mlp_forward", x, *layers, *outputs)


def _backward(
    saved: Sequence, grads: Sequence[Tensor], _: Sequence, needs: list[bool]
) -> list[Tensor | None]:
    """Gradients to all layers or to none."""
    x, weights, biases = saved
    n, need_x, need_layers = len(weights), needs[0], any(needs[1:])
    of_x = torch.empty_like(x) if need_x else None
    of_layers = [torch.empty_like(t) for t in (*weights, *biases)] if need_layers else []
    layers, into = (native.arrays(*weights), native.arrays(*biases)), native.arrays(*of_layers)
    native.call("mlp_backward", x, *layers, *grads, of_x, into[:n], into[n:])
    return [of_x, *(of_layers or [None] * (2 * n))]


@differentiable("x* weights*[] biases*[]", forward=_forward, backward=_backward)
def _mlp(x, weights, biases):
    return x.new_empty(len(x), len(biases[-1]))


# Small networks that decode what was composited along a ray, and what they read of directions.


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
        return mlp(x, [layer.weight for layer in linear], [layer.bias for layer in linear])


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
        return encode_hash(self.table, direction, *box, sizes, felt=self.felt)
