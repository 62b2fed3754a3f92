"""Environment maps from files."""

from __future__ import annotations

from pathlib import Path

from torch import Tensor

from univoxel.data.images import read_image
from univoxel.envmap import EnvMap
from univoxel.errors import DataError

UNDERSHOOT = 0.01  # of the largest radiance: texels that are less below 0 are 0


def read_map(path: Path) -> EnvMap:
    """A file as an environment map.

    Raises:
        DataError: it cannot be used as one; the message names it.
        OSError: it cannot be read.
    """
    radiance = read_image(path)
    if not radiance.is_floating_point():
        raise DataError(
            f"{path}: expected a map of light, .hdr or .exr, got a picture of 8 bits: the sun is "
            "thousands of times as bright as they can say"
        )
    if radiance.dim() == 3 and radiance.shape[2] == 4:
        radiance = radiance[..., :3]  # some writers add an alpha that says nothing
    if radiance.min() >= -UNDERSHOOT * radiance.max():  # as filters and denoisers leave it
        radiance = radiance.clamp_min(0)
    try:
        return EnvMap(radiance.contiguous())
    except ValueError as error:
        raise DataError(f"{path}: {error}") from None


def true_map(data: Path) -> Tensor | None:
    """The light of the photographs, where the data set has it."""
    for suffix in (".hdr", ".exr"):
        path = data / "envmaps" / f"train{suffix}"
        if path.is_file():
            return read_map(path).radiance
    return None
