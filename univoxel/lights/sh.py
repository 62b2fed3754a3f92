"""Light as spherical harmonics that vary over the surface."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor, nn

from univoxel import sphere
from univoxel.core.records import Occlusion, Surface
from univoxel.core.validation import check_fields
from univoxel.lights import base, quadrature
from univoxel.lights.base import (
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

    # name of this light, by which config.json tells it from the others
    kind: Literal["sh"] = field(default="sh", init=False)
    order: int = 3  # the highest degree, >= 0: 3 (order + 1)^2 numbers a point
    hidden: int = 64  # width of the head, >= 1
    layers: int = 2  # hidden layers of the head, [0, 32]
    directions: int = 256  # over the whole sphere, in training, >= 1
    directions_eval: int = 512  # in evaluation, >= 1
    scale: float = 1.0  # world units: half the extent of what is lit, > 0

    def __post_init__(self) -> None:
        check_fields(
            self, "at least 1", lambda x: x >= 1, "hidden", "directions", "directions_eval"
        )
        check_fields(self, "at least 0", lambda x: x >= 0, "order", "layers")
        most = f"at most {MOST_DIRECTIONS}"
        check_fields(self, most, lambda x: x <= MOST_DIRECTIONS, "directions", "directions_eval")
        check_fields(self, f"at most {MOST_LAYERS}", lambda x: x <= MOST_LAYERS, "layers")
        check_fields(self, "above 0", lambda x: 0 < x < math.inf, "scale")


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
            light_smoothness=base.smoothness(here, beside),
            white_light=base.chroma(light.mean(1)),
        )
