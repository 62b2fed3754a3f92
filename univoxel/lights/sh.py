"""Local light as spherical harmonics."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from univoxel import sphere
from univoxel.core.validation import check_settings, setting
from univoxel.lights.base import KIND, MOST_DIRECTIONS, MOST_LAYERS, LocalLightConfig
from univoxel.lights.quadrature import START, BasisLight


@dataclass(frozen=True)
class SHConfig(LocalLightConfig):
    """Local light in spherical harmonics."""

    kind: Literal["sh"] = field(default="sh", init=False, metadata=KIND)
    order: int = setting(3, "highest degree; each point has 3 (order + 1)^2 coefficients", least=0)
    hidden: int = setting(64, "width of the head", least=1)
    layers: int = setting(2, "number of hidden layers of the head", least=0, most=MOST_LAYERS)
    directions: int = setting(256, "directions in training", least=1, most=MOST_DIRECTIONS)
    directions_eval: int = setting(512, "directions in evaluation", least=1, most=MOST_DIRECTIONS)
    scale: float = setting(1.0, "half the longest side of the box", unit="world units", above=0)

    __post_init__ = check_settings


class LocalSH(BasisLight):
    """Real spherical harmonics a point: one global light plus what an MLP adds to it.

        L(w) = softplus(sum_lm c_lm Y_lm(w))

    The coefficients hold direct light, indirect light and visibility together. It starts at
    radiance 1/2 from everywhere.
    """

    config: SHConfig

    def __init__(
        self,
        features: int,
        config: SHConfig | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        """Arguments as of `AbstractLocalLight`."""
        config = config or SHConfig()
        start = torch.zeros((config.order + 1) ** 2, 3)
        start[0] = START * math.sqrt(4 * math.pi)  # Y_00 is 1 / sqrt(4 pi)
        super().__init__(features, config, start, generator)

    def basis(self, wi: Tensor) -> Tensor:
        """[..., (order + 1)^2] harmonics of unit directions [..., 3]."""
        return sphere.real_harmonics(self.config.order, wi)
