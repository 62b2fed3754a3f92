"""No lighting model: the colours of the photographs are used as albedo."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from univoxel.core.records import Occlusion, Surface
from univoxel.lights.base import KIND, AbstractLight, Regularisation


@dataclass(frozen=True)
class BakedConfig:
    """Shading stays in the albedo, as in a photogrammetry mesh with a texture."""

    kind: Literal["baked"] = field(default="baked", init=False, metadata=KIND)


class BakedLight(AbstractLight):
    """Every point sends its albedo along all directions.

    Under the L1 loss of training the albedo becomes the median of the colours that photographs show
    of the point: their robust mean. It is what a user has without inverse rendering, and what other
    lights are measured against.
    """

    traced = False

    def __init__(self, config: BakedConfig | None = None) -> None:
        super().__init__()
        self.config: BakedConfig = config or BakedConfig()

    @property
    def directions(self) -> int:
        return 1

    def incident(self, surface: Surface, wi: Tensor) -> Tensor:
        """1 [N, D, 3] from everywhere: under it a matte point without shadows sends its albedo."""
        return torch.ones_like(wi)

    def reflected(
        self,
        surface: Surface,
        wo: Tensor,
        occlusion: Occlusion | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """The albedo [N, 3]."""
        return surface.albedo

    def regularisation(self, surface: Surface, near: Surface) -> Regularisation:
        return Regularisation()
