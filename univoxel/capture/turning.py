"""Portrait photographs as landscape ones, and their cameras turned back.

Held either way it is one camera, but programs of structure from motion know one size a camera.
"""

from __future__ import annotations

import numpy as np
from PIL import Image


def to_landscape(picture: Image.Image) -> Image.Image:
    """A portrait picture turned counter-clockwise by 90 degrees; others as they are."""
    if picture.height <= picture.width:
        return picture
    return picture.transpose(Image.Transpose.ROTATE_90)


def points_back(points: np.ndarray, width: float) -> np.ndarray:
    """Pixel coordinates [..., 2] in the portrait picture of so many pixels across."""
    return np.stack([width - points[..., 1], points[..., 0]], -1)


def to_camera_back(to_camera: np.ndarray) -> np.ndarray:
    """World-to-camera [3, 3 or 4] of the portrait picture; axes x right, y down, z forward.

    The landscape picture's x axis is the portrait's y axis, and its y axis the opposite of x.
    """
    return np.stack([-to_camera[1], to_camera[0], to_camera[2]])
