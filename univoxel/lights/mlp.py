"""Local light as a network of position and direction."""

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
from univoxel.ops.networks import MLP, waves

_MEAN_OVER = 32  # directions that stand for the whole sphere where light is averaged
_START = 0.5  # radiance from everywhere


@dataclass(frozen=True)
class MLPLightConfig(LocalLightConfig):
    """Local light as two networks."""

    kind: Literal["mlp"] = field(default="mlp", init=False, metadata=KIND)
    rank: int = setting(32, "number of basis functions that make up the light", least=1)
    hidden: int = setting(64, "width of both networks", least=1)
    layers: int = setting(2, "hidden layers of both networks", least=0, most=MOST_LAYERS)
    frequencies: int = setting(3, "number of frequencies in the encoding of the direction", least=0)
    directions: int = setting(256, "directions in training", least=1, most=MOST_DIRECTIONS)
    directions_eval: int = setting(512, "directions in evaluation", least=1, most=MOST_DIRECTIONS)
    scale: float = setting(1.0, "half the extent of the lit region", unit="world units", above=0)

    __post_init__ = check_settings


class LocalMLP(AbstractLocalLight):
    """Incident light as a network of features, position and direction, kept affordable.

        L(x, w) = softplus(code(x) . basis(w))

    One network reads the point and gives a code, the other reads the direction and gives as many
    basis functions, the first of them constant. All points share the directions: N points under D
    directions cost N + D runs of a network and one matrix product, where a single network of both,
    as in NeILF, costs N D runs. What is lost is what a code of `rank` numbers a channel cannot say.
    It holds direct light, indirect light and visibility together, and starts at radiance 1/2 from
    everywhere.

    Source: Yao et al. 2022 (NeILF) for light as a network of place and direction.
    """

    config: MLPLightConfig

    def __init__(
        self,
        features: int,
        config: MLPLightConfig | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        """
        Args:
            features: C of Surface.features, >= 0.
            generator: draws the first weights.
        """
        super().__init__()
        self.config = config = config or MLPLightConfig()
        outputs = 3 * (config.rank + 1)
        self.head: MLP = build_head(features, config.hidden, config.layers, outputs, generator)
        sizes = [3 + 6 * config.frequencies, *[config.hidden] * config.layers, config.rank]
        self.basis_net: MLP = MLP(sizes, generator or torch.default_generator)
        base = torch.zeros(config.rank + 1, 3)
        base[0] = math.log(math.expm1(_START))
        self.base: nn.Parameter = nn.Parameter(base)  # [rank + 1, 3]

    @property
    def directions(self) -> int:
        return self.config.directions if self.training else self.config.directions_eval

    def code(self, surface: Surface) -> Tensor:
        """[N, rank + 1, 3] at each point."""
        raw = self.head(encode(surface, self.config.scale))
        return self.base + raw.unflatten(-1, (-1, 3))

    def basis(self, wi: Tensor) -> Tensor:
        """[..., rank + 1] of unit directions [..., 3]; the first is 1."""
        encoded = torch.cat([wi, *waves(wi, self.config.frequencies)], -1)
        values = self.basis_net(encoded.flatten(0, -2)).unflatten(0, wi.shape[:-1])
        return torch.cat([torch.ones_like(values[..., :1]), values], -1)

    def incident(self, surface: Surface, wi: Tensor) -> Tensor:
        """Radiance [N, D, 3] from unit directions wi [N, D, 3]; or [D, 3], the same for all."""
        return nn.functional.softplus(self.basis(wi) @ self.code(surface))

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
        here, beside = self.code(surface), self.code(near)
        wi = sphere.fibonacci_sphere(_MEAN_OVER).to(here)
        light = nn.functional.softplus(self.basis(wi) @ here)
        return Regularisation(
            light_smoothness=base.smoothness(here, beside), white_light=base.chroma(light.mean(1))
        )
