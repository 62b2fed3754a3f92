"""What stands between surface points and distant light: the scene's own surface."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from univoxel.color import srgb_to_linear
from univoxel.lights.quadrature import half_sphere
from univoxel.ops import VisibilityScene
from univoxel.records import Occlusion, Surface
from univoxel.scene import Scene


@torch.no_grad()
def occlusion(scene: Scene, surface: Surface, directions: int, rotation: Tensor) -> Occlusion:
    """Trace rays from N points over their half-spheres, D directions each.

    Light that is blocked is replaced by what the scene's radiance head says of the place that
    blocks it, seen from the point: all bounces at once, since the head is fitted to photographs.

    Args:
        directions: D, at least 1.
        rotation: [N] radians that they are turned by about each normal.

    Raises:
        ValueError: the scene has no surface.
    """
    wi = half_sphere(surface, directions, rotation)
    visible, indirect = trace_and_shade(scene, *occlusion_rays(scene, surface, wi))
    return Occlusion(rotation, visible.to(wi.dtype).view(wi.shape[:2]), indirect.view_as(wi))


def occlusion_rays(scene: Scene, surface: Surface, wi: Tensor) -> tuple[Tensor, Tensor]:
    """Rays from N points along wi [N, D, 3]: origins and directions, [N D, 3] each.

    They begin a voxel off the surface: rendered points lie only about on the mesh.
    """
    start = surface.position + scene.field.voxel_size * surface.normal
    return start[:, None].expand_as(wi).reshape(-1, 3), wi.reshape(-1, 3)


@torch.no_grad()
def trace_and_shade(
    scene: Scene, start: Tensor, away: Tensor, tracer: VisibilityScene | None = None
) -> tuple[Tensor, Tensor]:
    """Which of M rays meet nothing [M], and the radiance [M, 3] that comes from what others meet.

    Args:
        tracer: of another mesh than the scene's own.
    """
    hit = (tracer or scene.occluder()).closest_hit(start, away)
    blocked = (hit.face >= 0).nonzero()[:, 0]
    indirect = torch.zeros_like(away)
    place = start[blocked] + hit.t[blocked, None] * away[blocked]
    indirect[blocked] = outgoing(scene, place, -away[blocked])
    return hit.face < 0, indirect


def outgoing(scene: Scene, points: Tensor, wo: Tensor) -> Tensor:
    """Linear radiance [N, 3] that places [N, 3] on the surface send along wo [N, 3], as seen."""
    sample = scene.field.sample(points)
    normal = normalize(sample.gradient, dim=1, eps=1e-6)
    return srgb_to_linear(scene.radiance(scene.coded(sample.features), normal, wo))
