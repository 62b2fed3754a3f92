"""What the local lights share: the network that reads a surface point, and checks of its sizes."""

from __future__ import annotations

import itertools
import math
from typing import Any

import torch
from torch import Tensor, nn

from univoxel.records import Surface

FREQUENCIES = 3  # of the position: sines of 1, 2, 4 half-turns over the scale


def check(config: Any, at_least: dict[str, int], *above_zero: str) -> None:
    """Refuse a configuration with a number out of range.

    Raises:
        ValueError: names the number.
    """
    name = type(config).__name__
    for field, least in at_least.items():
        if getattr(config, field) < least:
            raise ValueError(f"{name}: {field} must be >= {least}, got {getattr(config, field)}")
    for field in above_zero:
        if not 0 < getattr(config, field) < math.inf:
            raise ValueError(f"{name}: {field} must be > 0, got {getattr(config, field)}")


def build(
    features: int, hidden: int, layers: int, outputs: int, generator: torch.Generator | None
) -> nn.Sequential:
    """A network from `encode` to what is added to a global light: at first nothing.

    Args:
        features: C of Surface.features, >= 0.
        hidden, layers: width and number of the hidden layers.
        generator: draws the first weights.
    """
    head = network(features + 3 + 6 * FREQUENCIES, hidden, layers, outputs, generator)
    last = head[-1]
    assert isinstance(last, nn.Linear)
    nn.init.zeros_(last.weight)  # the global light is the starting point
    return head


def network(
    inputs: int, hidden: int, layers: int, outputs: int, generator: torch.Generator | None
) -> nn.Sequential:
    """Linear layers with ReLU between them, biases zero at first."""
    stack: list[nn.Module] = []
    for before, after in itertools.pairwise([inputs] + [hidden] * layers):
        stack += [nn.Linear(before, after), nn.ReLU()]
    net = nn.Sequential(*stack, nn.Linear(hidden if layers else inputs, outputs))
    for layer in net:
        if isinstance(layer, nn.Linear):
            nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu", generator=generator)
            nn.init.zeros_(layer.bias)
    return net


def encode(surface: Surface, scale: float) -> Tensor:
    """Features, position and sines of it: [N, C + 3 + 18].

    Args:
        scale: world units: half the extent of what is lit.
    """
    angle = surface.position * (math.pi / scale)
    waves = [w for i in range(FREQUENCIES) for w in ((angle * 2**i).sin(), (angle * 2**i).cos())]
    return torch.cat([surface.features, surface.position / scale, *waves], -1)
