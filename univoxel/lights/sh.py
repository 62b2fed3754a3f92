"""Local light as spherical harmonics."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor, nn

from univoxel import sphere
from univoxel.core.records import Occlusion, Surface
from univoxel.core.validation import check_settings, setting
from univoxel.lights import base, quadrature
from univoxel.lights.base import (
    KIND,
    MOST_DIRECTIONS,
    MOST_LAYERS,
    AbstractLocalLight,
    LocalLightConfig,
    Regularisation,
    build_head,
    encode,
)
from univoxel.ops.networks import MLP

_MEAN_OVER = 32  # directions that stand for the whole sphere where light is averaged
_START = 0.5  # radiance from everywhere


@dataclass(frozen=True)
class SHConfig(LocalLightConfig):
    """Local light in spherical harmonics."""

    kind: Literal["sh"] = field(default="sh", init=False, metadata=KIND)
    order: int = setting(3, "highest degree; a point has 3 (order + 1)^2 numbers", least=0)
    hidden: int = setting(64, "width of the head", least=1)
    layers: int = setting(2, "hidden layers of the head", least=0, most=MOST_LAYERS)
    directions: int = setting(256, "directions in training", least=1, most=MOST_DIRECTIONS)
    directions_eval: int = setting(512, "directions in evaluation", least=1, most=MOST_DIRECTIONS)
    scale: float = setting(1.0, "half the extent of the lit region", unit="world units", above=0)

    __post_init__ = check_settings


class LocalSH(AbstractLocalLight):
    """Real spherical harmonics a point: one global light plus what an MLP adds to it.

        L(w) = softplus(sum_lm c_lm Y_lm(w))

    The coefficients hold direct light, indirect light and visibility together. A bare sum swings
    below zero beside every lamp. Clamped there, it would get no gradient and stay dark; softplus is
    positive, follows the sum where light is bright, and lets a dark direction come back. It starts
    at radiance 1/2 from everywhere.

    Light is taken on directions that all points share, so the harmonics are evaluated once per
    direction and a matrix product does the rest.
    """

    config: SHConfig

    def __init__(
        self,
        features: int,
        config: SHConfig | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        """
        Args:
            features: C of Surface.features, >= 0.
            generator: draws the head's first weights.
        """
        super().__init__()
        self.config = config = config or SHConfig()
        count = (config.order + 1) ** 2
        self.head: MLP = build_head(features, config.hidden, config.layers, 3 * count, generator)
        base = torch.zeros(count, 3)
        base[0] = math.log(math.expm1(_START)) * math.sqrt(4 * math.pi)  # Y_00 is 1 / sqrt(4 pi)
        self.base: nn.Parameter = nn.Parameter(base)  # [(order + 1)^2, 3]

    @property
    def directions(self) -> int:
        return self.config.directions if self.training else self.config.directions_eval

    def coefficients(self, surface: Surface) -> Tensor:
        """[N, (order + 1)^2, 3] of the sum that softplus is taken of."""
        raw = self.head(encode(surface, self.config.scale))
        return self.base + raw.unflatten(-1, (-1, 3))

    def incident(self, surface: Surface, wi: Tensor) -> Tensor:
        """Radiance [N, D, 3] from unit directions wi [N, D, 3]; or [D, 3], the same for all."""
        harmonics = sphere.real_harmonics(self.config.order, wi)
        return nn.functional.softplus(harmonics @ self.coefficients(surface))

    def reflected(
        self,
        surface: Surface,
        wo: Tensor,
        occlusion: Occlusion | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Radiance [N, 3] towards wo, summed over the whole sphere."""
        return quadrature.reflected_shared(self, surface, wo, occlusion, generator)

    def regularisation(self, surface: Surface, near: Surface) -> Regularisation:
        here, beside = self.coefficients(surface), self.coefficients(near)
        wi = sphere.fibonacci_sphere(_MEAN_OVER).to(here)
        light = nn.functional.softplus(sphere.real_harmonics(self.config.order, wi) @ here)
        return Regularisation(
            light_smoothness=base.smoothness(here, beside), white_light=base.chroma(light.mean(1))
        )
