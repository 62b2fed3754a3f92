"""The same photographs cut to differing sizes, each around what its mask shows."""

from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from univoxel.camera import Cameras, sizes_of, stacked
from univoxel.data import Photos, load_photos
from univoxel.data.images import write_png
from univoxel.data.transforms import write_cameras

# Pixels left around the object: more than training looks at, and than lookups reach
ROOM = 8


def windows(alpha: Tensor, step: int = 1, room: int = ROOM) -> list[tuple[slice, slice]]:
    """Rows and columns that stay of masks [V, H, W]: high, wide, small and whole pictures.

    Args:
        step: they begin at multiples of it.
        room: pixels left around the object.
    """
    kept = []
    for view, mask in enumerate(alpha):
        there = mask > 0
        spans = []
        for axis in (1, 0):
            place = there.any(axis).nonzero()[:, 0]
            low, high = int(place.min()) - room, int(place.max()) + 1 + room
            spans.append(slice(max(low, 0) // step * step, min(high, len(there.any(axis)))))
        rows, columns = spans
        if view % 4 in (0, 3):
            rows = slice(0, alpha.shape[1])
        if view % 4 in (1, 3):
            columns = slice(0, alpha.shape[2])
        kept.append((rows, columns))
    return kept


def cut_cameras(cameras: Cameras, kept: list[tuple[slice, slice]]) -> Cameras:
    """Cameras of the cut pictures."""
    corner = torch.tensor([[float(c.start), float(r.start)] for r, c in kept])
    sizes = [(c.stop - c.start, r.stop - r.start) for r, c in kept]
    width, height, of_each = sizes_of(sizes)
    return replace(
        cameras, centre=cameras.centre - corner, width=width, height=height, sizes=of_each
    )


def cropped(photos: Photos, step: int = 1, room: int = ROOM) -> Photos:
    """Photographs [V, H, W] of one size by their `windows`.

    What is stored beyond the pictures is bright and opaque: nobody may look at it."""
    kept = windows(photos.alpha, step, room)
    pictures = [
        tuple(stored[view][where] for stored in (photos.color, photos.alpha))
        for view, where in enumerate(kept)
    ]
    color, alpha = ([p[i] for p in pictures] for i in (0, 1))
    most = 255 if photos.color.dtype == torch.uint8 else 1.0
    return replace(
        photos,
        color=stacked(color, beyond=most),
        alpha=stacked(alpha, beyond=most),
        cameras=cut_cameras(photos.cameras, kept),
    )


def write_cropped(data: Path, out: Path) -> Path:
    """The photographs of a data set in the NeRF layout, of differing sizes, with some truth."""
    for split in ("train", "test"):
        photos = cropped(load_photos(data, split))
        (out / split).mkdir(parents=True)
        for view, name in enumerate(photos.names):
            color, alpha = photos.stored(view)
            write_png(out / split / f"{name}.png", torch.cat([color, alpha[..., None]], -1))
        write_cameras(out, split, photos.cameras, photos.names)
    return out
