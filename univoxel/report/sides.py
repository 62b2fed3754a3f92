"""The object from four sides, as layers."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from univoxel.bars import track
from univoxel.brdf import metal_or_none
from univoxel.camera import Cameras
from univoxel.color import linear_to_srgb
from univoxel.confidence.doubts import Doubts
from univoxel.names import ELEVATION
from univoxel.pictures.contact_sheet import heat
from univoxel.pictures.viewpoints import orbit
from univoxel.records import Mesh, Surface
from univoxel.render.pipeline import shade_hits, surface_of_view
from univoxel.report.photographs import BEHIND, on_grey
from univoxel.scene import Scene

SIDES = ("front", "right", "back", "left")


@torch.no_grad()
def layers(
    scene: Scene, mesh: Mesh, size: int, front: float, doubts: Doubts | None
) -> dict[str, list[Tensor]]:
    """Pictures [size, size, 3], sRGB, of each of SIDES, by layer: render, albedo, roughness, metal
    where there is any, normal, and doubt where it is known.

    Args:
        front: azimuth of the front, degrees from +X.
    """
    cameras = orbit(mesh, len(SIDES), size, ELEVATION, front)
    found: dict[str, list[Tensor]] = {}
    for view in track(range(len(SIDES)), "rendering layers"):
        for name, picture in _of_view(scene, cameras, view, doubts):
            found.setdefault(name, []).append(picture)
    if not any(bool((picture > BEHIND + 0.05).any()) for picture in found["metal"]):
        del found["metal"]
    return found


def _of_view(
    scene: Scene, cameras: Cameras, view: int, doubts: Doubts | None
) -> Iterator[tuple[str, Tensor]]:
    surface, wo = surface_of_view(scene, cameras, view)
    width, height = cameras.size(view)
    alpha = surface.opacity.reshape(height, width)

    def grid(values: Tensor) -> Tensor:
        return values.reshape(height, width, -1)

    def plain(values: Tensor) -> Tensor:
        over = alpha[..., None]
        return grid(values).expand(-1, -1, 3) * over + BEHIND * (1 - over)

    yield "render", on_grey(grid(shade_hits(scene, surface, wo)), alpha)
    yield "albedo", plain(linear_to_srgb(surface.albedo))
    yield "roughness", plain(surface.roughness)
    yield "metal", plain(_metal(surface) * (1 - BEHIND))
    yield "normal", plain(0.5 * surface.normal + 0.5)
    if doubts is not None:
        met = (surface.opacity > 0).nonzero()[:, 0]
        doubt = torch.zeros_like(surface.opacity)
        doubt[met] = doubts.at(surface.position[met], surface.normal[met])[:, 0].clamp(0, 1)
        yield "doubt", plain(torch.from_numpy(heat(doubt, 1.0)).float())


def _metal(surface: Surface) -> Tensor:
    metal = None if surface.metallic is None else metal_or_none(surface.metallic)
    return torch.zeros_like(surface.roughness) if metal is None else metal
