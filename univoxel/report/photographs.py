"""Photographs beside what the scene shows from there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from univoxel.bars import track
from univoxel.camera import resize
from univoxel.color import linear_to_srgb
from univoxel.data import Photos
from univoxel.metrics import psnr
from univoxel.pictures.contact_sheet import heat
from univoxel.pictures.shrunk import shrunk
from univoxel.render.pipeline import shade_hits, surface_of_view
from univoxel.scene import Scene

SCOUTED = 48  # pixels along a picture by which views are compared
MOST = 150  # photographs that are compared, spread over all
LIMIT = 0.2  # mean difference in sRGB that is drawn brightest
BEHIND = 0.11  # sRGB, behind the object


@dataclass(frozen=True)
class Split:
    """Photographs, with cameras where they are believed to be."""

    photos: Photos
    trained: bool  # whether training saw them: then each has its own exposure and light


@dataclass(frozen=True)
class Compared:
    """A photograph and a render [h, w, 3], sRGB on the same grey."""

    name: str
    trained: bool
    photograph: Tensor
    render: Tensor
    inside: Tensor  # [h, w] bool: where either shows the object

    @property
    def difference(self) -> Tensor:
        """[h, w] mean absolute difference."""
        return (self.render - self.photograph).abs().mean(-1)

    @property
    def error(self) -> float:
        """Its mean over the object."""
        return float(self.difference[self.inside].mean()) if self.inside.any() else 0.0

    @property
    def quality(self) -> float:
        """PSNR over the object, dB."""
        inside = self.inside if self.inside.any() else torch.ones_like(self.inside)
        return float(psnr(self.render[inside], self.photograph[inside]))

    @property
    def tiles(self) -> tuple[Tensor, Tensor, Tensor]:
        """Photograph, render and difference as colours."""
        return self.photograph, self.render, torch.from_numpy(heat(self.difference, LIMIT))


def worst(scene: Scene, splits: list[Split], count: int, size: int) -> tuple[list[Compared], int]:
    """The views that differ most from their photographs, the worst first; how many were compared.

    Args:
        size: most pixels along the pictures that are returned.
    """
    views = [(split, view) for split in splits for view in range(len(split.photos))]
    every = -(-len(views) // MOST)
    views = views[::every]
    errors = [
        compared(scene, split, view, SCOUTED).error
        for split, view in track(views, "comparing photographs")
    ]
    order = sorted(range(len(views)), key=lambda k: -errors[k])[:count]
    found = [compared(scene, *views[k], size) for k in order]
    return sorted(found, key=lambda view: -view.error), len(views)


@torch.no_grad()
def compared(scene: Scene, split: Split, view: int, size: int) -> Compared:
    """One view, at most `size` pixels along its longer side."""
    photos = split.photos
    longest = max(*photos.cameras.size(view))
    share = min(1.0, size / longest)
    cameras = resize(photos.cameras, max(1, round(share * photos.cameras.width)))
    width, height = cameras.size(view)
    small = shrunk(photos, view, width, height)
    surface, wo = surface_of_view(scene, cameras, view)
    rgb = shade_hits(scene, surface, wo, view if split.trained else None)
    opacity = surface.opacity.reshape(height, width)
    both = (small[..., :3], small[..., 3]), (rgb.reshape(height, width, 3), opacity)
    photograph, render = (on_grey(rgb, alpha) for rgb, alpha in both)
    inside = (small[..., 3] > 0.5) | (opacity > 0.5)
    return Compared(photos.names[view], split.trained, photograph, render, inside)


def on_grey(premultiplied: Tensor, alpha: Tensor) -> Tensor:
    """Linear colours [h, w, 3], premultiplied, as sRGB on what stands behind them in a report."""
    straight = premultiplied / alpha[..., None].clamp_min(1e-6)
    return linear_to_srgb(straight) * alpha[..., None] + BEHIND * (1 - alpha[..., None])


def rows(found: list[Compared]) -> Iterator[tuple[str, tuple[Tensor, Tensor, Tensor]]]:
    """What stands under each view, and its pictures."""
    for view in found:
        kind = "" if view.trained else " (not trained on)"
        words = f"{view.name}{kind}: {view.error:.3f} in sRGB on the mean, {view.quality:.1f} dB"
        yield words, view.tiles
