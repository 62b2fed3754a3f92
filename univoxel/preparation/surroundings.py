"""Whether what stands around the object stood still before the camera, as on a turntable."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from univoxel.data import Photos
from univoxel.preparation.matches import neighbours

# Pixels along the longer side of the pictures whose surroundings are compared
SMALL = 128
# Of those pixels, by which a camera that stands still may wobble, or be turned a little
WOBBLE = 3
# By which surroundings are shifted, to see whether that fits better: less than a camera sees them
# shift that goes some 5 degrees around the object
SHIFT = 10
# Correlation that surroundings which stood still have at least
ALIKE = 0.85
# Correlation of a picture with itself shifted, above which it is too plain to tell
PLAIN = 0.95


@torch.no_grad()
def surroundings_stand_still(photos: Photos) -> bool | None:
    """Whether neighbouring photographs show the same around the object, at the same pixels.

    A camera that goes around an object sees its surroundings shift. None: they cannot tell, since
    they are plain or cut away.
    """
    stand_still = []
    for one, other in neighbours(photos.cameras):
        if photos.cameras.size(one) == photos.cameras.size(other):
            first, second = _shrunk(photos, one), _shrunk(photos, other)
            stand_still.append(_same(first, second))
    known = [same for same in stand_still if same is not None]
    if 2 * len(known) <= len(stand_still):
        return None
    return 2 * sum(known) > len(known)


def _shrunk(photos: Photos, view: int) -> tuple[Tensor, Tensor]:
    """A small picture [h, w], grey sRGB or linear values, and where it shows no object [h, w]."""
    color, alpha = photos.stored(view)
    factor = max(1, round(max(alpha.shape) / SMALL))
    grey = avg_pool2d(color.float().mean(-1)[None], factor)[0]
    shown = max_pool2d((alpha > 0).float()[None], factor)  # of the object, anywhere in a pixel
    return grey, max_pool2d(shown, 3, 1, 1)[0] == 0


def _same(one: tuple[Tensor, Tensor], other: tuple[Tensor, Tensor]) -> bool | None:
    """Whether two pictures agree around the object as they lie, and not better shifted far."""
    here = _correlation(one, other, 0, 0)
    at_rest = [*([] if here is None else [here]), *_shifted(one, other, WOBBLE)]
    itself, far = _shifted(one, one, SHIFT), _shifted(one, other, SHIFT)
    # Plain surroundings look alike wherever they are
    if not (at_rest and itself and far) or max(itself) > PLAIN:
        return None
    return max(at_rest) > max(ALIKE, *far)


def _shifted(one: tuple[Tensor, Tensor], other: tuple[Tensor, Tensor], pixels: int) -> list[float]:
    """Correlations with the other shifted so far, to all sides."""
    sides = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0)]
    found = (_correlation(one, other, pixels * y, pixels * x) for y, x in sides)
    return [correlation for correlation in found if correlation is not None]


def _correlation(
    one: tuple[Tensor, Tensor], other: tuple[Tensor, Tensor], down: int, right: int
) -> float | None:
    """Of grey values around the object, the other picture shifted; None: of nothing, or of one
    colour."""
    height, width = one[0].shape
    y, x = slice(max(down, 0), height + min(down, 0)), slice(max(right, 0), width + min(right, 0))
    v, u = (
        slice(max(-down, 0), height + min(-down, 0)),
        slice(max(-right, 0), width + min(-right, 0)),
    )
    both = one[1][y, x] & other[1][v, u]
    if both.float().mean() < 0.1:
        return None
    a, b = one[0][y, x][both], other[0][v, u][both]
    a, b = a - a.mean(), b - b.mean()
    size = float(a.norm() * b.norm())
    return float(a @ b) / size if size > 1e-3 * len(a) else None
