"""What the local lights share: a global light, and a network that adds to it at each point."""

from __future__ import annotations

import math
from abc import ABC

import torch
from torch import Tensor, nn

from univoxel.lights.base import AbstractLight
from univoxel.networks import MLP, waves
from univoxel.records import Surface

FREQUENCIES = 3  # of the position: sines of 1, 2, 4 half-turns over the scale


class LocalLightConfig(ABC):
    """What the configurations of all local lights have."""

    hidden: int  # width of the head, >= 1
    scale: float  # world units: half the extent of what is lit, > 0


class AbstractLocalLight(AbstractLight):
    """Light that differs from point to point and holds direct light, indirect light and visibility
    together: `base`, the same everywhere, plus what `head` makes of a point."""

    traced = False
    config: LocalLightConfig
    head: MLP  # from `encode` of the surface
    base: nn.Parameter


def build_head(
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
