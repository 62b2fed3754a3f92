"""What the cameras of the photographs are off by, learned beside the scene."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from univoxel.camera import Cameras, project
from univoxel.errors import UserError


class PoseSteps(nn.Module):
    """A small rotation and translation for each of V cameras, about a point of the object.

    Camera to world becomes x -> E (x - pivot) + pivot + radius u, E the rotation by the vector r.
    About the object, not about the camera: there turning and shifting a camera look alike, here
    each moves the picture in its own way, and by about as much. What all cameras have in common -
    a rotation, a translation, a scale of the whole world - is taken out, to first order: no
    photograph shows it, and test views would not follow.

    Source: Lin et al. 2021 (BARF) for poses learned with the scene; the gauge as in bundle
    adjustment.
    """

    pivot: Tensor  # [3] world
    radius: Tensor  # [] world units
    away: Tensor  # [V, 3] what a scale of the world would do to u, of length 1 in all

    def __init__(self, count: int) -> None:
        """For so many cameras, V; `about` says where the object is."""
        super().__init__()
        self.steps: nn.Parameter = nn.Parameter(torch.zeros(count, 6))  # r in radians, u
        self.register_buffer("pivot", torch.zeros(3))
        self.register_buffer("radius", torch.tensor(1.0))
        self.register_buffer("away", torch.zeros(count, 3))

    def about(self, cameras: Cameras, pivot: Tensor, radius: float) -> None:
        """Say where cameras are said to be, the middle [3] of the object and its radius, > 0."""
        self.pivot, self.radius = pivot.clone(), torch.tensor(radius)
        away = _centred(cameras.camera_to_world[:, :, 3] - pivot)
        self.away = away / away.norm().clamp_min(1e-12)

    def __len__(self) -> int:
        return len(self.steps)

    def corrected(self, cameras: Cameras) -> Cameras:
        """The cameras where they are believed to be; differentiable in training.

        Raises:
            UserError: another number of cameras.
        """
        if len(cameras) != len(self):
            raise UserError(
                f"the run was trained on {len(self)} photographs with refined cameras, got "
                f"{len(cameras)}"
            )
        steps = self.steps if self.training else self.steps.detach()
        turn, shift = _centred(steps).split(3, 1)
        shift = shift - self.away * (shift * self.away).sum()
        pose = cameras.camera_to_world
        rotation = torch.linalg.matrix_exp(_cross(turn))
        place = rotation @ (pose[:, :, 3] - self.pivot)[:, :, None]
        place = place + (self.pivot + self.radius * shift)[:, :, None]
        return replace(cameras, camera_to_world=torch.cat([rotation @ pose[:, :, :3], place], 2))

    @torch.no_grad()
    def moved(self, cameras: Cameras) -> Tensor:
        """How far the object's middle and six points around it move in each picture: [V] pixels,
        root mean square."""
        around = torch.cat([torch.zeros(1, 3), torch.eye(3), -torch.eye(3)])
        points, after = self.pivot + self.radius * around, self.corrected(cameras)
        pairs = (
            project(after, v, points)[0] - project(cameras, v, points)[0] for v in range(len(self))
        )
        return torch.stack([d.square().sum(1).mean().sqrt() for d in pairs])


def _centred(values: Tensor) -> Tensor:
    return values - values.mean(0)


def _cross(vector: Tensor) -> Tensor:
    """Matrices [V, 3, 3] that multiply by vectors [V, 3] as the cross product does."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
