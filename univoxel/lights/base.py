"""The interface of all lights."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from univoxel.records import Surface


class AbstractLight(nn.Module, ABC):
    """Light that falls on surface points. Declares; a leaf implements each method once."""

    @abstractmethod
    def incident(
        self,
        surface: Surface,
        wi: Tensor,  # [N, D, 3]
    ) -> Tensor:
        """Linear radiance [N, D, 3] >= 0 that arrives at N points from unit world directions wi."""

    @abstractmethod
    def reflected(
        self,
        surface: Surface,
        wo: Tensor,  # [N, 3]
        visibility: Tensor | None = None,  # [N, D]
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Linear radiance [N, 3] that N points send along unit world directions wo.

        Args:
            visibility: share of the light that arrives, in [0, 1], for each of the D directions
                that the light shades with; its own docstring says what it makes of it.
            generator: turns the directions of a quadrature at random for each point; without one
                the result is deterministic.
        """
