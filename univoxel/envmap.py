"""Equirectangular environment maps: from files, lookup, and sampling in proportion to their
light."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from univoxel.color import luminance
from univoxel.core import log
from univoxel.data.images import SUFFIXES, kind_of, read_image
from univoxel.data.truth import map_file
from univoxel.errors import DataError
from univoxel.ops.integrator import EnvTables
from univoxel.sphere import direction_to_latlong, rotate_z, texel_solid_angles


@dataclass(frozen=True)
class EnvMap:
    """Light from far away, in the axes of docs/reference/conventions.md.

    Raises:
        ValueError: the map is not [H, 2H, 3] floating, negative or not finite; exposure is.
    """

    radiance: Tensor  # [H, W, 3] float32 linear, >= 0; W = 2 H
    rotation: float = 0.0  # degrees, counter-clockwise about +Z seen from above
    exposure: float = 1.0  # factor on the radiance, >= 0

    def __post_init__(self) -> None:
        r = self.radiance
        shape = list(r.shape)
        if r.dim() != 3 or shape[0] < 1 or shape[1] != 2 * shape[0] or shape[2] != 3:
            raise ValueError(
                f"environment map: expected an array [H, W, 3] with W = 2 H, got {shape}"
            )
        if r.dtype != torch.float32:
            raise ValueError(f"environment map: expected float32 radiance, got {r.dtype}")
        low, high = r.aminmax()  # NaN if there is one
        if not (low >= 0 and high < math.inf):
            bad = (~r.isfinite() | (r < 0)).nonzero()
            row, column, channel = bad[0].tolist()
            raise ValueError(
                "environment map: expected finite radiance of at least 0, got "
                f"{r[row, column, channel].item()} in row {row}, column {column} and "
                f"{len(bad) - 1} more such values"
            )
        if not math.isfinite(self.rotation):
            raise ValueError(f"environment map: rotation must be finite, got {self.rotation}")
        if not 0 <= self.exposure < math.inf:
            raise ValueError(
                f"environment map: exposure must be finite and at least 0, got {self.exposure}"
            )


def lookup(envmap: EnvMap, direction: Tensor) -> Tensor:
    """Radiance [..., 3] from directions [..., 3] (unit, world).

    Bilinear between pixel centres, around the border in phi, clamped at the poles.
    Differentiable in: radiance, direction.
    """
    width = envmap.radiance.shape[1]
    turn = direction.new_tensor(-math.radians(envmap.rotation))
    u, v = direction_to_latlong(rotate_z(direction, turn)).unbind(-1)
    # One column more on either side, from beyond the border: grid_sample knows no other way around
    texel = torch.cat([envmap.radiance[:, -1:], envmap.radiance, envmap.radiance[:, :1]], 1)
    place = torch.stack([2 * (u * width + 1) / (width + 2) - 1, 2 * v - 1], -1)
    found = grid_sample(
        texel.to(place.dtype).movedim(2, 0)[None],
        place.reshape(1, 1, -1, 2),
        padding_mode="border",
        align_corners=False,
    )
    return envmap.exposure * found[0, :, 0].T.reshape(direction.shape)


def tables(envmap: EnvMap) -> EnvTables:
    """Tables that draw texels in proportion to their light, for `relight`.

    A texel's share is its solid angle times the luminance of the interpolated map, averaged over
    the texel: wherever a lookup finds light, the share is above 0. A black map is drawn uniformly.
    """
    height, width, _ = envmap.radiance.shape
    light = luminance(envmap.radiance.double())
    # The mean of the interpolant over a texel weighs it and its two neighbours 6 : 1 : 1 an axis.
    light = 0.75 * light + 0.125 * (light.roll(1, 1) + light.roll(-1, 1))
    padded = torch.cat([light[:1], light, light[-1:]])
    light = 0.75 * light + 0.125 * (padded[:-2] + padded[2:])
    solid = texel_solid_angles(height, width).double()
    share = light * solid
    if not share.any():
        share = solid
    # A row without light is never chosen; any table will do for it.
    share_in_row = torch.where(share.any(1, keepdim=True), share, 1.0)
    row_cdf, column_cdf = _cdf(share.sum(1)), _cdf(share_in_row)
    # What the tables in float32 do draw, which is what a sample has to be divided by.
    drawn = row_cdf.diff()[:, None] * column_cdf.diff() / solid
    radiance = envmap.exposure * envmap.radiance
    return EnvTables(
        texel=torch.cat([radiance, drawn.float()[..., None]], -1).contiguous(),
        row_cdf=row_cdf,
        column_cdf=column_cdf,
        rotation=math.radians(envmap.rotation),
    )


def background(tables: EnvTables, direction: Tensor) -> Tensor:
    """Radiance [N, 3] of the map that tables were made of, exposure and rotation included."""
    return lookup(EnvMap(tables.radiance, math.degrees(tables.rotation)), direction)


def _cdf(share: Tensor) -> Tensor:
    """Normalised running sums along the last axis, from 0 to exactly 1: [..., n + 1] float32."""
    total = torch.nn.functional.pad(share.cumsum(-1), (1, 0))
    return (total / total[..., -1:]).float().contiguous()


# Environment maps from files.


UNDERSHOOT = 0.01  # of the largest radiance: texels that are less below 0 are 0


def read_map(path: Path) -> EnvMap:
    """A file as an environment map; a DataError, which names it, or an OSError if it cannot be
    used."""
    if path.suffix.lower() in SUFFIXES and kind_of(path) not in (".exr", ".hdr"):
        raise DataError(
            f"{path}: expected an environment map (.hdr or .exr), got an image with 8 or 16 bits, "
            "which cannot hold the brightness of the sun"
        )
    radiance = read_image(path, infinite=True)
    if radiance.dim() == 3 and radiance.shape[2] == 4:
        radiance = radiance[..., :3]  # some writers add an alpha that says nothing
    low, high = radiance.aminmax()
    if high == math.inf:  # of a sun that half floats do not hold
        largest = torch.where(radiance.isfinite(), radiance, 0).max()
        log.warning("%s: infinite radiance is replaced by %g", path, largest)
        radiance = radiance.clamp_max(largest)
        high = largest
    if 0 > low >= -UNDERSHOOT * high:  # as filters and denoisers leave it
        radiance = radiance.clamp_min(0)
    try:
        return EnvMap(radiance.contiguous())
    except ValueError as error:
        raise DataError(f"{path}: {error}") from None


def true_map(data: Path) -> Tensor | None:
    """The true light of the photographs, if the data set has it."""
    path = map_file(data / "envmaps", "train")
    return None if path is None else read_map(path).radiance
