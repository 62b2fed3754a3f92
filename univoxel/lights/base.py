"""The interface of all lights."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import torch
from torch import Tensor, nn

from univoxel.records import Occlusion, Surface


class AbstractLight(nn.Module, ABC):
    """Light that falls on surface points. Declares; a leaf implements each method once."""

    traced: ClassVar[bool]  # whether the light is distant, so that `reflected` wants an occlusion

    @property
    @abstractmethod
    def directions(self) -> int:
        """D, along which `reflected` sums up light: fewer in training mode than in evaluation."""

    @abstractmethod
    def incident(
        self,
        surface: Surface,
        wi: Tensor,  # [N, D, 3]
    ) -> Tensor:
        """Linear radiance [N, D, 3] >= 0 that arrives at N points from unit world directions wi.

        Nothing stands in the way of a light that is traced.
        """

    @abstractmethod
    def reflected(
        self,
        surface: Surface,
        wo: Tensor,  # [N, 3]
        occlusion: Occlusion | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Linear radiance [N, 3] that N points send along unit world directions wo.

        Args:
            occlusion: what is in the light's way. A local light holds that already: where it is
                given nevertheless, it takes its share.
            generator: turns the directions of a quadrature at random; without one the result is
                deterministic. An occlusion brings its own directions.
        """

    @abstractmethod
    def regularisation(self, surface: Surface, near: Surface) -> dict[str, Tensor]:
        """What keeps the light likely: terms >= 0, by the weight in LossConfig they belong to.

        Args:
            surface, near: N points of the surface, and one right beside each.
        """
