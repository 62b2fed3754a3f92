"""The light that was recovered, as one map, whichever model of light it is."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from univoxel.color import linear_to_srgb, luminance
from univoxel.lights import AbstractLocalLight
from univoxel.pictures.balls import map_and_balls
from univoxel.records import Mesh, Surface
from univoxel.render.transport import surface_points
from univoxel.scene import Scene
from univoxel.sphere import latlong_directions

ROWS = 128  # of a map
LOCAL_ROWS = 32  # of the map of a local light, which is smooth
POINTS = 512  # of the surface, that a local light is asked at
AT_ONCE = 64  # of them


@dataclass(frozen=True)
class FoundLight:
    """A map of light, and where it comes from."""

    radiance: Tensor  # [H, 2 H, 3] linear
    about: str  # for people


@torch.no_grad()
def found_light(scene: Scene, mesh: Mesh) -> FoundLight | None:
    """The scene's environment map; of a local light its mean over the surface; None: neither.

    What a local light says of a direction is meant for points that face it: there it was learned.
    """
    sky = scene.environment()
    if sky is not None:
        about = "The environment map that was recovered."
        return FoundLight(scene.exposed(sky.latlong(ROWS)), about)
    if not isinstance(scene.light, AbstractLocalLight):
        return None
    about = (
        f"This run has no environment map: its light is local ({scene.cfg.light.kind}) and differs "
        "from point to point. The map shows what points that face a direction get from there, on "
        "the mean; it holds the shadows of the object on itself too."
    )
    if scene.cfg.turntable is not None:
        about += " It stands in the room of the turntable."
    return FoundLight(local_map(scene, mesh), about)


def local_map(scene: Scene, mesh: Mesh) -> Tensor:
    """The mean light [LOCAL_ROWS, 2 LOCAL_ROWS, 3] of points, by the cosine at which it arrives."""
    position, normal = surface_points(mesh, POINTS, torch.Generator().manual_seed(0))
    wi = latlong_directions(LOCAL_ROWS).flatten(0, 1)
    total, weight = torch.zeros(len(wi), 3), torch.full((len(wi), 1), 1e-6)
    for index in torch.arange(POINTS).split(AT_ONCE):
        features = scene.coded(scene.field.features_at(position[index]))
        one = torch.ones(len(index))
        surface = Surface(
            position[index], normal[index], features, one[:, None].expand(-1, 3), one, one, one
        )
        radiance = scene.light.incident(surface, wi.expand(len(index), -1, -1))
        # A turning light has no direction that a point faces for good
        facing = torch.ones(len(index), len(wi))
        if scene.cfg.turntable is None:
            facing = (surface.normal @ wi.T).clamp_min(0)
        total += torch.einsum("nd,ndc->dc", facing, radiance)
        weight += facing.sum(0)[:, None]
    return scene.exposed(total / weight).view(LOCAL_ROWS, 2 * LOCAL_ROWS, 3)


def pictures_of(found: FoundLight) -> list[Tensor]:
    """Map, grey ball and mirror ball [ROWS, ..., 3], sRGB, as bright as shows most of the map."""
    bright = luminance(found.radiance).quantile(0.9).clamp_min(1e-6)
    return [linear_to_srgb(tile) for tile in map_and_balls(found.radiance / bright, ROWS)]
