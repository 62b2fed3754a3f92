"""Lens distortion, and the pinhole cameras of undistorted images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from univoxel.data.images import image_size, turn_note
from univoxel.errors import DataError, UserError

ZOOM = (0.5, 2.0)  # of the pinhole against the lens, at most
HALVINGS = 30  # of the interval above: far below a thousandth of a pixel
EDGE_POINTS = 65  # along each border of a picture, where it is asked what a lens sees
# Of the longer side: a focal length in them is of a view of 0.0006 to 179.9 degrees. Beyond,
# directions of neighbouring pixels are one in float32, or the picture's border is at infinity
FOCALS = (5e-4, 1e5)
STRONGEST = 1e6  # coefficient of distortion; the squares of larger ones leave float32
TALLER = 0.01  # share by which a shrunk picture may be taller or wider than its original
SHRUNK = 1.25  # times as wide as a picture that its camera must be for it to be a shrunk copy
FARTHEST = 1e9  # of a camera from the origin, world units: volumes of boxes stay within float32


@dataclass(frozen=True)
class Lens:
    """What a camera does to directions: a pinhole, with radial and tangential distortion on top.

    A direction (x, y, 1), x right, y down, r^2 = x^2 + y^2, is seen at centre + focal (x', y'):

        x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6 + ..) + 2 p1 x y + p2 (r^2 + 2 x^2)
        y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6 + ..) + p1 (r^2 + 2 y^2) + 2 p2 x y

    Source: Brown 1966, with the names and signs of OpenCV and COLMAP.
    """

    width: int
    height: int
    focal: tuple[float, float]  # pixels, along x and y
    centre: tuple[float, float]  # pixels from the top left corner
    radial: tuple[float, ...] = (0.0, 0.0, 0.0)  # k1, k2, k3 and on
    tangential: tuple[float, float] = (0.0, 0.0)  # p1, p2

    @property
    def bent(self) -> bool:
        return any(self.radial) or any(self.tangential)

    def seen(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixel coordinates of the directions (x, y, 1)."""
        p1, p2 = self.tangential
        rr = x * x + y * y
        *others, last = self.radial
        factor = 1 + rr * reduce(lambda inner, k: k + rr * inner, reversed(others), last)
        bent_x = x * factor + 2 * p1 * x * y + p2 * (rr + 2 * x * x)
        bent_y = y * factor + p1 * (rr + 2 * y * y) + 2 * p2 * x * y
        return (self.centre[0] + self.focal[0] * bent_x, self.centre[1] + self.focal[1] * bent_y)


def checked(lens: Lens) -> Lens:
    """The lens, if float32 can hold what it does, or else a UserError."""
    side = max(lens.width, lens.height)
    low, high = (share * side for share in FOCALS)
    if not all(low <= focal <= high for focal in lens.focal):
        x, y = lens.focal
        raise UserError(
            f"expected focal lengths from {low:.4g} to {high:.4g} pixels for images of "
            f"{lens.width}x{lens.height}, got {x:.4g} and {y:.4g}"
        )
    if not all(abs(at) <= high for at in lens.centre):
        raise UserError(
            f"expected principal point coordinates from {-high:.4g} to {high:.4g} pixels, got "
            f"{lens.centre}"
        )
    if not all(abs(k) <= STRONGEST for k in (*lens.radial, *lens.tangential)):
        raise UserError(
            f"expected distortion coefficients of magnitude up to {STRONGEST:.0e}, got "
            f"{(*lens.radial, *lens.tangential)}"
        )
    return lens


def straightened(lens: Lens) -> Lens:
    """The pinhole with a picture of the same size that sees as much as can be without empty pixels.

    It shares the centre, and its focal lengths have the lens's ratio. A UserError where the
    distortion folds the picture over, or leaves too little of it.
    """
    if not lens.bent:
        return lens
    low, high = ZOOM
    if not _fits(lens, high):
        raise UserError(f"removing lens distortion would leave less than 1/{high:g} of the width")
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        low, high = (low, middle) if _fits(lens, middle) else (middle, high)
    pinhole = _zoomed(lens, high)
    if _folds(lens, pinhole):
        raise UserError("the lens distortion folds the image over itself: check its coefficients")
    return pinhole


def sources(lens: Lens, pinhole: Lens) -> Tensor:
    """Where the pixels of a pinhole's picture lie in the lens's: [H, W, 2], for `straighten`."""
    # float32 is worth a few 1e-4 pixels here, and half the memory of large pictures
    column, row = np.meshgrid(
        np.arange(pinhole.width, dtype=np.float32) + 0.5,
        np.arange(pinhole.height, dtype=np.float32) + 0.5,
    )
    x, y = lens.seen(*_directions(pinhole, column, row))
    return torch.from_numpy(np.stack([2 * x / lens.width - 1, 2 * y / lens.height - 1], -1))


def straighten(picture: Tensor, sources: Tensor) -> Tensor:
    """A lens's picture as its pinhole sees it, bilinear: [H, W, C] -> [H, W, C]."""
    return torch.nn.functional.grid_sample(
        picture.movedim(-1, 0)[None], sources[None], align_corners=False, padding_mode="border"
    )[0].movedim(0, -1)


def shrunk(lens: Lens, factor: int) -> Lens:
    """The same view in a picture of 1/factor of the size, rows and columns left over cut off."""
    width, height = lens.width // factor, lens.height // factor
    focal, centre = ((x / factor, y / factor) for x, y in (lens.focal, lens.centre))
    return replace(lens, width=width, height=height, focal=focal, centre=centre)


def shrink(picture: Tensor, factor: int) -> Tensor:
    """Means over squares of factor^2 pixels: [H, W, C] -> [H // factor, W // factor, C]."""
    return torch.nn.functional.avg_pool2d(picture.movedim(-1, 0), factor).movedim(0, -1)


def _zoomed(lens: Lens, zoom: float) -> Lens:
    focal = (zoom * lens.focal[0], zoom * lens.focal[1])
    return Lens(lens.width, lens.height, focal, lens.centre)


def _directions(pinhole: Lens, column: np.ndarray, row: np.ndarray):
    x = (column - pinhole.centre[0]) / pinhole.focal[0]
    y = (row - pinhole.centre[1]) / pinhole.focal[1]
    return x, y


def _fits(lens: Lens, zoom: float) -> bool:
    """Whether the border of the zoomed pinhole's picture lies within the lens's."""
    width, height = lens.width, lens.height
    across, down = np.linspace(0, width, EDGE_POINTS), np.linspace(0, height, EDGE_POINTS)
    column = np.concatenate([across, across, np.zeros_like(down), np.full_like(down, width)])
    row = np.concatenate([np.zeros_like(across), np.full_like(across, height), down, down])
    x, y = lens.seen(*_directions(_zoomed(lens, zoom), column, row))
    return bool(((x >= 0) & (x <= width) & (y >= 0) & (y <= height)).all())


def _folds(lens: Lens, pinhole: Lens) -> bool:
    """Whether neighbouring directions change sides somewhere in the pinhole's picture."""
    column, row = np.meshgrid(
        np.linspace(0, lens.width, EDGE_POINTS), np.linspace(0, lens.height, EDGE_POINTS)
    )
    x, y = lens.seen(*_directions(pinhole, column, row))
    xx, xy = np.gradient(x, axis=1), np.gradient(x, axis=0)
    yx, yy = np.gradient(y, axis=1), np.gradient(y, axis=0)
    return bool((xx * yy - xy * yx <= 0).any())


def is_shrunk(width: int, height: int, of: tuple[int, int]) -> bool:
    """Whether a picture of this size is one of that size that was made smaller, and not cut."""
    factor = of[0] / max(width, 1)
    return factor >= SHRUNK and abs(of[1] / factor - height) < 1


def fitted(lens: Lens, picture: Path, where: str) -> Lens:
    """The lens of a picture that may be smaller than those that the lens was found with; a
    DataError where it has another shape."""
    w, h = image_size(picture)
    across, down = w / lens.width, h / lens.height
    if abs(across / down - 1) > TALLER + 1 / min(w, h):
        raise DataError(
            f"{picture}: expected the aspect ratio {lens.width:g}x{lens.height:g} of its camera in "
            f"{where}, got {w}x{h}{turn_note(picture)}"
        )
    (fx, fy), (cx, cy) = lens.focal, lens.centre
    focal, centre = (fx * across, fy * down), (cx * across, cy * down)
    try:
        return checked(replace(lens, width=w, height=h, focal=focal, centre=centre))
    except UserError as error:
        raise DataError(f"{where}: {error}") from None
