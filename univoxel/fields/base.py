"""What every field of the scene's geometry and appearance offers."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor, nn

from univoxel.records import FieldSample, Rays, Samples


class AbstractField(nn.Module, ABC):
    """A signed distance and C features everywhere in a box."""

    channels: int  # C
    voxel_size: float  # finest resolution, world units

    @abstractmethod
    def sample(self, points: Tensor) -> FieldSample:
        """SDF, its spatial gradient and features at world points [M, 3]."""

    @abstractmethod
    def march(self, rays: Rays, jitter: Tensor, inv_s: float) -> Samples:
        """The samples along rays that matter under density sharpness 1 / s; no gradients."""

    @abstractmethod
    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lower and upper corner [3], [3] of the box, world units."""
