"""One distant light for the whole object: an environment map at D nodes, which is solved for."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from univoxel import sphere
from univoxel.lights.latlong import resampled

NODES_AT_ONCE = 8192


class DistantLight(nn.Module):
    """Radiance at D directions of a Fibonacci sphere, 4 pi / D steradians each; kept as logarithm,
    so that it stays positive and a bright sun is as far away as a dark wall.

    Where something polished showed the same map more sharply, its texels lie beside. They serve
    pictures of it, and light for other things.
    """

    direction: Tensor
    sharp: Tensor | None  # [R, 2 R, 3] radiance, linear

    def __init__(self, count: int, radiance: float = 1.0, rows: int = 0) -> None:
        """
        Args:
            rows: R of the texels, 0: there are none.
        """
        super().__init__()
        self.log_radiance: nn.Parameter = nn.Parameter(
            torch.full((count, 3), math.log(radiance))
        )  # [D, 3]
        self.register_buffer("direction", sphere.fibonacci_sphere(count))  # [D, 3]
        self.register_buffer("sharp", torch.zeros(rows, 2 * rows, 3) if rows else None)

    @property
    def radiance(self) -> Tensor:
        """[D, 3] linear."""
        return self.log_radiance.exp()

    def changed(self, log_change: Tensor) -> DistantLight:
        """Another light, whose logarithm is this one's plus [D, 3]; without gradients."""
        light = DistantLight(len(self.direction)).to(self.direction)
        light.log_radiance.data.copy_(self.log_radiance.detach() + log_change.detach())
        return light

    def incident(self, wi: Tensor) -> Tensor:
        """Radiance [M, 3] from unit directions wi [M, 3], interpolated between the nodes.

        Weights are normalised Gaussians about as wide as the nodes lie apart.
        """
        sharpness = len(self.direction) / 5.0
        parts = []
        for w in wi.split(NODES_AT_ONCE):
            parts.append(torch.softmax(sharpness * (w @ self.direction.T), 1) @ self.radiance)
        return torch.cat(parts)

    def latlong(self, height: int) -> Tensor:
        """The map [height, 2 height, 3], linear, in the axes of docs/reference/conventions.md."""
        if self.sharp is not None:
            return resampled(self.sharp, height)
        wi = sphere.latlong_directions(height)
        return self.incident(wi.flatten(0, 1)).reshape(height, 2 * height, 3)
