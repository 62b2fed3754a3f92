"""The interface of all lights."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from univoxel.records import Occlusion, Surface

MOST_DIRECTIONS = 1 << 16  # that light is summed up over: memory of a batch grows with them
MOST_LAYERS = 32  # of a network: without shortcuts deeper ones do not learn
MOST_ROWS = 1 << 13  # of a map


@dataclass(frozen=True)
class Regularisation:
    """What keeps a light likely: terms [] >= 0, None where the light has no such term.

    Each is weighted by the field of LossConfig of its name.
    """

    light_smoothness: Tensor | None = None  # how far light changes over the surface
    map_smoothness: Tensor | None = None  # how far a map changes over the sphere
    white_light: Tensor | None = None  # how far light is from grey on the whole


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
    def regularisation(self, surface: Surface, near: Surface) -> Regularisation:
        """What keeps the light likely.

        Args:
            surface, near: N points of the surface, and one right beside each.
        """
