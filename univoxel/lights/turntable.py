"""Light that turns with the camera: the object was turned before a camera that stood still."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from univoxel.camera import Cameras, looked_at
from univoxel.errors import ConfigError
from univoxel.orbit import circle_of

Vec3 = tuple[float, float, float]
LEVEL = 0.2  # spread of the cameras' right axes along their axis over that across it, at most
UPRIGHT = 0.97  # cosine between that axis and the one of the circle they stand on, at least


@dataclass(frozen=True)
class Turntable:
    """The axis about which an object was turned, while camera and light stood still.

    In the world, which is the object's, the light turns about the axis as the camera does. Its own
    frame is the world as it was when the camera stood at `start`.
    """

    point: Vec3  # of the axis, world units
    axis: Vec3  # unit
    start: Vec3  # unit, across the axis: from it to the camera

    def __post_init__(self) -> None:
        axis, start = torch.tensor(self.axis), torch.tensor(self.start)
        lengths = float((axis.norm() - 1).abs().maximum((start.norm() - 1).abs()))
        if not max(lengths, float((axis @ start).abs())) < 1e-3:
            raise ConfigError(
                "Turntable: axis and start must be unit vectors across each other, got "
                f"{self.axis} and {self.start}"
            )

    @staticmethod
    def of(cameras: Cameras) -> Turntable | None:
        """The turntable that cameras stood around; None: they do not say where its axis is.

        A camera that stands still is held level: what is to the right in the photographs lies
        across the axis. Turned all around, the cameras look at a point of it. Where they stand on
        one circle, it says both more exactly: however it was aimed, the camera stood still.
        """
        right = cameras.camera_to_world[:, :, 0]
        _, spread, directions = torch.linalg.svd(right, full_matrices=True)
        if len(cameras) < 3 or spread[2] > LEVEL * spread[1]:
            return None
        axis, point, circle = directions[2], looked_at(cameras), circle_of(cameras)
        if circle is not None and abs(float(circle.axis @ axis.double())) > UPRIGHT:
            axis, centre = circle.axis.to(axis), circle.centre.to(axis)
            point = centre + ((point - centre) @ axis) * axis
        if axis @ cameras.camera_to_world[:, :, 1].mean(0) < 0:
            axis = -axis
        towards = cameras.camera_to_world[0, :, 3] - point
        start = normalize(towards - (towards @ axis) * axis, dim=0)
        if not start.isfinite().all() or start.norm() < 0.5:  # the first stands on the axis
            return None
        values = (tuple(x.tolist()) for x in (point, axis, start))
        return Turntable(*values)

    def turn(self, eye: Tensor) -> tuple[Tensor, Tensor]:
        """Cosine and sine [...] of how far the light has turned about the axis, seen from
        [..., 3]."""
        point, axis, start = (eye.new_tensor(x) for x in (self.point, self.axis, self.start))
        beside = torch.linalg.cross(axis, start)
        towards = eye - point
        along, across = towards @ start, towards @ beside
        length = torch.hypot(along, across).clamp_min(1e-9)
        return along / length, across / length

    def into_light(self, direction: Tensor, turn: tuple[Tensor, Tensor]) -> Tensor:
        """World directions [..., 3] in the light's frame.

        Args:
            turn: of where they are seen from, as of `turn`; [...] or broadcast to it.
        """
        return self._rotated(direction, turn[0], -turn[1])

    def into_world(self, direction: Tensor, turn: tuple[Tensor, Tensor]) -> Tensor:
        """The inverse of `into_light`."""
        return self._rotated(direction, *turn)

    def _rotated(self, direction: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
        """Turned about the axis (Rodrigues' formula)."""
        axis = direction.new_tensor(self.axis)
        along = (direction @ axis)[..., None] * axis
        beside = torch.linalg.cross(axis.expand_as(direction), direction)
        return along + cosine[..., None] * (direction - along) + sine[..., None] * beside


def resampling(direction: Tensor, turntable: Turntable, turn: tuple[Tensor, Tensor]) -> Tensor:
    """Weights [V, D, D] that bring a map at D directions, in the light's frame, to what it is in
    the world along these directions, for V views.

    Args:
        direction: [D, 3] unit, evenly spread over the sphere.
        turn: [V] of the views.
    """
    sharpness = len(direction) / 5.0  # as wide as the nodes lie apart, as in `DistantLight`
    cosine, sine = (x[:, None] for x in turn)
    turned = turntable.into_light(direction.expand(len(cosine), -1, -1), (cosine, sine))
    weights = torch.softmax(sharpness * (turned @ direction.T), -1)
    # What rounding swallows is nothing: processors take a hundred times as long over the tiniest
    # numbers (denormals), of which half of the weights were, or became when multiplied
    weights = weights.masked_fill(weights < torch.finfo(weights.dtype).eps, 0.0)
    return weights / weights.sum(-1, keepdim=True)
