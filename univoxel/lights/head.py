"""What the local lights share: the network that reads a surface point, and checks of its sizes."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from univoxel.errors import ConfigError
from univoxel.networks import MLP, waves
from univoxel.records import Surface

FREQUENCIES = 3  # of the position: sines of 1, 2, 4 half-turns over the scale


def check(config: Any, at_least: dict[str, int], *above_zero: str) -> None:
    """Refuse a configuration with a number out of range.

    Raises:
        ConfigError: names the number.
    """
    name = type(config).__name__
    for field, least in at_least.items():
        if getattr(config, field) < least:
            raise ConfigError(f"{name}: {field} must be >= {least}, got {getattr(config, field)}")
    for field in above_zero:
        if not 0 < getattr(config, field) < math.inf:
            raise ConfigError(f"{name}: {field} must be > 0, got {getattr(config, field)}")


def build(
    features: int, hidden: int, layers: int, outputs: int, generator: torch.Generator | None
) -> MLP:
    """A network from `encode` to what is added to a global light: at first nothing.

    Args:
        features: C of Surface.features, >= 0.
        hidden, layers: width and number of the hidden layers.
        generator: draws the first weights.
    """
    inputs = features + 3 + 6 * FREQUENCIES
    head = MLP([inputs, *[hidden] * layers, outputs], generator or torch.default_generator)
    nn.init.zeros_(head.linear[-1].weight)  # the global light is the starting point
    return head


def encode(surface: Surface, scale: float) -> Tensor:
    """Features, position and sines of it: [N, C + 3 + 18].

    Args:
        scale: world units: half the extent of what is lit.
    """
    fine = waves(surface.position * (math.pi / scale), FREQUENCIES)
    return torch.cat([surface.features, surface.position / scale, *fine], -1)
