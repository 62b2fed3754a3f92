"""Local light as a network of position and direction."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from univoxel.core.validation import check_settings, setting
from univoxel.lights.base import KIND, MOST_DIRECTIONS, MOST_LAYERS, LocalLightConfig
from univoxel.lights.quadrature import START, BasisLight
from univoxel.ops.networks import MLP, waves


@dataclass(frozen=True)
class MLPLightConfig(LocalLightConfig):
    """Local light as two networks."""

    kind: Literal["mlp"] = field(default="mlp", init=False, metadata=KIND)
    rank: int = setting(32, "number of basis functions that the light combines", least=1)
    hidden: int = setting(64, "width of both networks", least=1)
    layers: int = setting(2, "number of hidden layers of both networks", least=0, most=MOST_LAYERS)
    frequencies: int = setting(3, "number of frequencies in the encoding of the direction", least=0)
    directions: int = setting(256, "directions in training", least=1, most=MOST_DIRECTIONS)
    directions_eval: int = setting(512, "directions in evaluation", least=1, most=MOST_DIRECTIONS)
    scale: float = setting(1.0, "half the longest side of the box", unit="world units", above=0)

    __post_init__ = check_settings


class LocalMLP(BasisLight):
    """Incident light as a network of features, position and direction, kept affordable.

    One network reads the point and gives coefficients, the other reads the direction and gives as
    many basis functions, the first of them constant. N points under D directions cost N + D runs of
    a network and one matrix product, where a single network of both, as in NeILF, costs N D runs.
    What is lost is what `rank` numbers a channel cannot say. It holds direct light, indirect light
    and visibility together, and starts at radiance 1/2 from everywhere.

    Source: Yao et al. 2022 (NeILF) for light as a network of place and direction.
    """

    config: MLPLightConfig

    def __init__(
        self,
        features: int,
        config: MLPLightConfig | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        """Arguments as of `AbstractLocalLight`."""
        config = config or MLPLightConfig()
        start = torch.zeros(config.rank + 1, 3)
        start[0] = START
        super().__init__(features, config, start, generator)
        sizes = [3 + 6 * config.frequencies, *[config.hidden] * config.layers, config.rank]
        self.basis_net: MLP = MLP(sizes, generator or torch.default_generator)

    def basis(self, wi: Tensor) -> Tensor:
        """[..., rank + 1] of unit directions [..., 3]; the first is 1."""
        encoded = torch.cat([wi, *waves(wi, self.config.frequencies)], -1)
        values = self.basis_net(encoded.flatten(0, -2)).unflatten(0, wi.shape[:-1])
        return torch.cat([torch.ones_like(values[..., :1]), values], -1)
