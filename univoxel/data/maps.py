"""Environment maps from files."""

from __future__ import annotations

from pathlib import Path

from torch import Tensor

from univoxel.data.images import read_image
from univoxel.envmap import EnvMap
from univoxel.errors import DataError


def read_map(path: Path) -> EnvMap:
    """A file as an environment map.

    Raises:
        DataError: it cannot be used as one; the message names it.
        OSError: it cannot be read.
    """
    radiance = read_image(path)
    if radiance.dim() == 3 and radiance.shape[2] == 4:
        radiance = radiance[..., :3]  # some writers add an alpha that says nothing
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
