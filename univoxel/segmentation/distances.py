"""A field of distances that is kept one, and the boxes that an object is looked for in."""

from __future__ import annotations

import numpy as np
import torch
from scipy import ndimage
from skimage.measure import label
from torch import Tensor

from univoxel.camera import Cameras, looked_at
from univoxel.errors import NothingFound, UserError
from univoxel.fields.field import Field

# Voxels from the surface within which the sdf is left as it is
NEAR = 1.5
# Share of the largest part's volume; smaller ones are dropped
SMALLEST_PART = 0.02


def corners(box: tuple[float, ...]) -> tuple[Tensor, Tensor]:
    """Lower and upper corner [3] of six numbers.

    Raises:
        UserError: they are no box.
    """
    values = torch.tensor(box)
    if len(box) != 6 or not values.isfinite().all() or not (values[:3] < values[3:]).all():
        raise UserError(
            "box: expected X Y Z of the lower corner and then of the upper, which is above it in "
            f"all three, got {' '.join(f'{x:g}' for x in box)}",
            "box",
        )
    return values[:3], values[3:]


def surroundings(cameras: Cameras) -> tuple[Tensor, Tensor]:
    """A cube around what the cameras look at, as large as half of their pictures show whole."""
    centre = looked_at(cameras)
    away = (cameras.camera_to_world[:, :, 3] - centre).norm(dim=1)
    tangent = cameras.size_of_each().amin(1) / (2 * cameras.focal.max(1).values)
    half = float((away * tangent / (1 + tangent.square()).sqrt()).median())
    return centre - half, centre + half


@torch.no_grad()
def redistance_(field: Field, whole: bool = False) -> None:
    """Make the sdf a distance again, but for what is near the surface.

    Args:
        whole: also take away parts that are small against the largest.

    Raises:
        NothingFound: nothing is inside.
    """
    sdf = field.sdf.detach().numpy()
    inside = sdf < 0
    if whole:
        parts = np.asarray(label(inside))
        volume = np.bincount(parts[inside], minlength=1)
        inside &= (volume >= SMALLEST_PART * volume.max())[parts]
    if not inside.any():
        raise NothingFound
    outside, depth = (ndimage.distance_transform_edt(m) for m in (~inside, inside))
    distance = np.asarray(outside) - np.asarray(depth)
    distance = (distance - 0.5 * np.sign(distance)) * field.voxel_size
    near = NEAR * field.voxel_size
    keep = (np.abs(sdf) < near) & (np.abs(distance) < near)
    keep &= inside == (sdf < 0)
    field.sdf.copy_(torch.from_numpy(np.where(keep, sdf, distance)).float())


def surface_box(field: Field, lower: Tensor, upper: Tensor, margin: float) -> tuple[Tensor, Tensor]:
    """A box around the surface, within that of lower and upper.

    Args:
        margin: share of its diagonal that is left free around it.
    """
    vertices, _ = field.isosurface()
    low, high = vertices.amin(0), vertices.amax(0)
    free = margin * (high - low).norm()
    return torch.maximum(low - free, lower), torch.minimum(high + free, upper)
