"""The records that every loader returns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from univoxel.camera import Cameras
from univoxel.color import srgb_to_linear
from univoxel.core import memmap


@dataclass(frozen=True)
class Photos:
    """Posed photographs of one split. Of differing sizes, they are stored as `Cameras` says."""

    folder: Path
    names: list[str]  # V, unique within the split, such as r_000
    # [V, H, W, 3] uint8 sRGB, or float32 linear radiance; straight, not premultiplied
    color: Tensor
    alpha: Tensor  # [V, H, W] uint8 (0 to 255) or float32 (0 to 1) coverage
    cameras: Cameras
    about: str = ""  # what was read and how, for people
    downscale: int = 1  # pixels of the files along a side of one of these
    origin: str = ""  # of pixels that are not those of the files, as in `image_cache.origin_of`
    # Read the file of each photograph again, shrunk to 1/factor: stored colour [H, W, 3], as its
    # pinhole sees it. Empty where photographs are from no files
    readers: tuple[Callable[[int], Tensor], ...] = ()
    # [3, 4] float64, rotation and translation from the world of the files to that of `cameras`;
    # None: they are one
    moved: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.names)

    def pixels(self, view: Tensor, row: Tensor, column: Tensor) -> tuple[Tensor, Tensor]:
        """Linear straight colour [..., 3] and alpha [...] of pixels, float32."""
        return decode(self.color[view, row, column], self.alpha[view, row, column])

    def of(self, views: Tensor) -> Photos:
        """Those of some views [K] int64."""
        names = [self.names[view] for view in views.tolist()]
        color, alpha, cameras = self.color[views], self.alpha[views], self.cameras.of(views)
        readers = tuple(self.readers[view] for view in views.tolist() if self.readers)
        return replace(
            self, names=names, color=color, alpha=alpha, cameras=cameras, readers=readers
        )

    def without(self, pixels: Tensor) -> Photos:
        """The same with no object at pixels [V, H, W] bool."""
        alpha = memmap.zeros(self.alpha.shape, self.alpha.dtype)
        for view in range(len(self)):
            alpha[view] = self.alpha[view].masked_fill(pixels[view], 0)
        return replace(self, alpha=alpha)

    def coverage(self) -> Tensor:
        """Alpha of all pixels [V, H, W], float32 in [0, 1]; 0 beyond a picture."""
        return coverage_of(self.alpha)

    def picture(self, view: int) -> tuple[Tensor, Tensor]:
        """Linear straight colour [h, w, 3] and alpha [h, w] of one view, float32."""
        return decode(*self.stored(view))

    def stored(self, view: int) -> tuple[Tensor, Tensor]:
        """Colour [h, w, 3] and alpha [h, w] of one view, in its own size, as they are stored."""
        return self.cameras.cut(view, self.color[view]), self.cameras.cut(view, self.alpha[view])


def decode(color: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Stored pixels to linear float32."""
    if color.dtype == torch.uint8:
        color = srgb_to_linear(color.float() / 255)
    return color, coverage_of(alpha)


def coverage_of(alpha: Tensor) -> Tensor:
    """Stored alpha as float32 in [0, 1]."""
    return alpha.float() / 255 if alpha.dtype == torch.uint8 else alpha


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


@dataclass(frozen=True)
class Truth:
    """Ground truth of one test view, as far as a data set has it; float32, linear, row 0 on top."""

    albedo: Tensor | None = None  # [H, W, 3]
    roughness: Tensor | None = None  # [H, W]
    normal: Tensor | None = None  # [H, W, 3] unit, world; shading normal
    mask: Tensor | None = None  # [H, W] bool: well inside the object
    depth: Tensor | None = None  # [H, W] along the camera's -Z, world units; 0 background
