"""Pictures of a scene's present state."""

from __future__ import annotations

from pathlib import Path

import torch

from univoxel.color import linear_to_srgb
from univoxel.data import Photos
from univoxel.data.images import write_png
from univoxel.render.pipeline import shade_hits, surface_of_view
from univoxel.scene import Scene


def preview(scene: Scene, photos: Photos, path: Path, view: int = 0) -> None:
    """One photograph beside what the scene says of it: photo, render, albedo, roughness, normal."""
    width, height = photos.cameras.size(view)
    surface, wo = surface_of_view(scene, photos.cameras, view)
    color, alpha = photos.picture(view)
    opacity = surface.opacity[:, None]
    tiles = [
        linear_to_srgb(color * alpha[..., None]),
        linear_to_srgb(shade_hits(scene, surface, wo, view)),
        linear_to_srgb(surface.albedo * opacity),
        surface.roughness[:, None].expand(-1, 3) * opacity,
        (0.5 + 0.5 * surface.normal) * opacity,
    ]
    write_png(path, torch.cat([t.reshape(height, width, 3) for t in tiles], 1))
