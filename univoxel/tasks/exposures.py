"""Whether photographs were exposed alike, and by how much each was not."""

from __future__ import annotations

import math

from torch import Tensor

from univoxel.data import Photos
from univoxel.fields.hull import GridShape
from univoxel.scene import Varying
from univoxel.solve.exposures import log_gains

# Stops, root mean square, from which on exposures count as different. Where they are alike, what
# reflects and a hull that is too large look like 0.01 to 0.16. All of metal, or light that changes,
# look like 0.25: gains do no harm there
DIFFERENT = 0.2


def exposures(
    photos: Photos, hull: Tensor, grid: GridShape, varying: Varying, look: bool
) -> tuple[Varying, Tensor | None]:
    """What differs from photograph to photograph, and their log gains [V] where anything does.

    Args:
        photos: V, their cameras where they are believed to be.
        hull: [X, Y, Z] sdf of the visual hull, world units.
        grid: of the hull.
        varying: what is known to differ.
        look: whether to find out if exposures do, where nothing is known to differ.
    """
    if varying == "none" and not look:
        return varying, None
    gains = log_gains(photos, hull, grid)
    stops = float(gains.square().mean().sqrt()) / math.log(2)
    if varying == "none":
        if stops < DIFFERENT:
            return varying, None
        varying = "exposure"
        print(
            f"exposures differ by {stops:.2f} stops from photograph to photograph: a gain is "
            "learned for each, see --varying"
        )
    return varying, gains
