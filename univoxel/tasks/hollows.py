"""Hollows opened before training, where there is time for it."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from univoxel.camera import Cameras
from univoxel.color import linear_to_srgb
from univoxel.data import Photos
from univoxel.fields.hollows import hollowed
from univoxel.fields.hull import GridShape, looked_at

VIEWS = 100  # photographs at most that say what is hollow
PIXEL_SECONDS = 1e-5  # that a pixel of the object takes, about, on two cores


def opened(
    hull: Tensor, grid: GridShape, photos: Photos, gains: Tensor | None, seconds: float
) -> Tensor:
    """The sdf [X, Y, Z] of a hull with its hollows open, or the hull: see `hollowed`.

    Args:
        hull: [X, Y, Z] sdf of the visual hull, world units.
        grid: of the hull.
        photos: V, their cameras where they are believed to be.
        gains: [V] log gains of their exposures.
        seconds: that it may take; where more are expected the hull stays as it is.
    """
    views, factor = _samples(photos.cameras, grid.voxel_size)
    pixels = int(photos.alpha[views].count_nonzero()) / factor**2
    if PIXEL_SECONDS * pixels > seconds:
        return hull
    return hollowed(hull, grid, *pictures_of(photos, grid.voxel_size, gains))


def pictures_of(
    photos: Photos, voxel_size: float, gains: Tensor | None = None
) -> tuple[Tensor, Cameras]:
    """Photographs and cameras as `hollowed` takes them: some, with pixels between half a voxel and
    a voxel wide where the photographs' are narrower, and without their log gains [V]."""
    views, factor = _samples(photos.cameras, voxel_size)
    pictures = []
    for view in views.tolist():
        color, alpha = photos.picture(view)
        if gains is not None:
            color = color / gains[view].exp()
        premultiplied = torch.cat([linear_to_srgb(color) * alpha[..., None], alpha[..., None]], 2)
        shrunk = avg_pool2d(premultiplied.permute(2, 0, 1), factor)
        pictures.append((255 * shrunk.permute(1, 2, 0)).round().byte())
    height, width = pictures[0].shape[:2]
    whole = photos.cameras
    pose, focal, centre = whole.camera_to_world[views], whole.focal[views], whole.centre[views]
    return torch.stack(pictures), Cameras(pose, focal / factor, centre / factor, width, height)


def _samples(cameras: Cameras, voxel_size: float) -> tuple[Tensor, int]:
    """Which views [K] are looked at, and how many pixels make one along a side."""
    views = torch.arange(0, len(cameras), -(-len(cameras) // VIEWS))
    away = (cameras.camera_to_world[:, :, 3] - looked_at(cameras)).norm(dim=1)
    pixel = float((away / cameras.focal.mean(1)).median())
    return views, max(1, int(voxel_size / pixel))
