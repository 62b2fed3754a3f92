"""Which pixels of the photographs training looks at."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from univoxel import memmap
from univoxel.data import Photos
from univoxel.data.base import decode

MARGIN = 6.0  # pixels around the silhouettes that are trained on; farther ones are empty
MOST = (
    1 << 24
)  # pixels that are trained on, at most; the longest preset draws about ten million rays
HELD_OUT = 2048  # pixels of the training photographs that are only looked at, to follow quality


@dataclass(frozen=True)
class TrainingPixels:
    """Photographs, and which of their pixels serve what.

    Pixels are rows of int32: view, row and column, and, of photographs that lie on disk, the stored
    colour and alpha after them, as `packed` has them.
    """

    photos: Photos
    trained: Tensor  # [P, 3 and more]
    held_out: Tensor  # only looked at, to follow quality
    edges_given: bool = True  # whether masks are as given, and none of their edges doubted


def split_pixels(photos: Photos, distance: Tensor, doubted: Tensor | None = None) -> TrainingPixels:
    """The pixels in or near silhouettes: those to train on, and some that are held out.

    Of more than MOST a random MOST are taken: trainings draw fewer rays.

    Args:
        distance: [V, H, W] pixels to the silhouette, negative inside; infinite beyond a picture.
        doubted: [V, H, W] bool, where masks are not believed: left out, here and, as if there were
            no object, wherever the photographs are looked at later.
    """
    if doubted is not None:
        photos = replace(photos, alpha=_without(photos.alpha, doubted))
    counts = [int(_near(distance, doubted, view).sum()) for view in range(len(photos))]
    draw = torch.Generator().manual_seed(0)
    if sum(counts) > MOST:
        share = MOST / sum(counts)
        counts = [round(share * count) for count in counts]
    with_colors = memmap.on_disk(photos.color)
    width = 3 + (packed_width(photos) if with_colors else 0)
    pixels = torch.empty(sum(counts), width, dtype=torch.int32)
    for view, part in enumerate(pixels.split(counts)):
        found = _near(distance, doubted, view).nonzero()
        if len(found) > len(part):
            found = found[torch.randperm(len(found), generator=draw)[: len(part)]]
        part[:, 0] = view
        part[:, 1:3] = found
        if with_colors:
            part[:, 3:] = packed(photos, view, found)
    order = torch.randperm(len(pixels), generator=torch.Generator().manual_seed(0))
    held = min(HELD_OUT, len(pixels) // 10)
    if not held:  # so few that none can be spared
        return TrainingPixels(photos, pixels, pixels)
    if with_colors:
        return TrainingPixels(photos, *_taken_out_(pixels, order[:held]))
    return TrainingPixels(photos, pixels[order[held:]], pixels[order[:held]])


def _taken_out_(pixels: Tensor, chosen: Tensor) -> tuple[Tensor, Tensor]:
    """Rows without the chosen ones [K], and these; in the memory of all, in another order."""
    taken, last = pixels[chosen], len(pixels) - len(chosen)
    stays = torch.ones(len(pixels), dtype=torch.bool)
    stays[chosen] = False
    pixels[chosen[chosen < last]] = pixels[last + stays[last:].nonzero()[:, 0]]
    return pixels[:last], taken


def _near(distance: Tensor, doubted: Tensor | None, view: int) -> Tensor:
    """Which pixels [H, W] of a view are looked at."""
    near = distance[view] < MARGIN
    return near if doubted is None else near & ~doubted[view]


def _without(alpha: Tensor, doubted: Tensor) -> Tensor:
    """Alpha [V, H, W] that is 0 where it is doubted."""
    result = memmap.zeros(alpha.shape, alpha.dtype)
    for view in range(len(alpha)):
        result[view] = alpha[view].masked_fill(doubted[view], 0)
    return result


def packed_width(photos: Photos) -> int:
    """Numbers that `packed` makes of a pixel."""
    return sum(-(-n * t.element_size() // 4) for n, t in ((3, photos.color), (1, photos.alpha)))


def packed(photos: Photos, view: int, place: Tensor) -> Tensor:
    """Stored colour and alpha of pixels [N, 2] (row, column) of a view, as int32 [N, 2] or, of
    photographs in floating point, up to [N, 4]."""
    row, column = place.unbind(1)
    color, alpha = photos.color[view][row, column], photos.alpha[view][row, column, None]
    return torch.cat([_as_int32(color), _as_int32(alpha)], 1)


def unpacked(photos: Photos, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Linear straight colour [N, 3] and alpha [N] of what `packed` gave."""
    split = packed_width(photos) - 1
    color = rows[:, :split].contiguous().view(photos.color.dtype)[:, :3]
    alpha = rows[:, split:].contiguous().view(photos.alpha.dtype)[:, 0]
    return decode(color, alpha)


def _as_int32(stored: Tensor) -> Tensor:
    """The bytes of numbers [N, K], and zeros after them, as int32 [N, M]."""
    raw = stored.contiguous().view(torch.uint8)
    return torch.nn.functional.pad(raw, (0, -raw.shape[1] % 4)).view(torch.int32)
