"""One distant light for the whole object: an environment map of spherical Gaussians."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor, nn

from univoxel.lights import lobes, priors
from univoxel.lights.base import MOST_DIRECTIONS, MOST_ROWS, Regularisation
from univoxel.lights.latlong import AbstractLatLongLight, LatLongConfig
from univoxel.records import Surface
from univoxel.sphere import latlong_directions
from univoxel.validation import check_fields

GAIN = 10.0  # the learning rate of networks moves the lobes that much faster: they must reach a sun


@dataclass(frozen=True)
class EnvmapSGConfig(LatLongConfig):
    """An environment map of spherical Gaussians, with traced visibility."""

    # name of this light, by which config.json tells it from the others
    kind: Literal["envmap-sg"] = field(default="envmap-sg", init=False)
    lobes: int = 128  # of the map, >= 1
    max_sharpness: float = 100.0  # of a lobe, > 0; its half width is about sqrt(2 / sharpness) rad
    rows: int = 64  # of the lat-long map that the lobes are summed on, >= 1
    directions: int = 64  # of the half-sphere, in training, >= 1
    directions_eval: int = 256  # in evaluation, >= 1

    def __post_init__(self) -> None:
        check_fields(
            self, "at least 1", lambda x: x >= 1, "lobes", "rows", "directions", "directions_eval"
        )
        check_fields(self, "above 0", lambda x: 0 < x < math.inf, "max_sharpness")
        most = f"at most {MOST_DIRECTIONS}"
        check_fields(self, most, lambda x: x <= MOST_DIRECTIONS, "directions", "directions_eval")
        check_fields(self, f"at most {MOST_ROWS}", lambda x: x <= MOST_ROWS, "rows")


class EnvmapSGLight(AbstractLatLongLight):
    """K spherical Gaussians of direction, the same for all points.

        L(w) = sum_k amplitude_k exp(sharpness_k (w . axis_k - 1))

    N points under D directions would ask for K exponentials each; instead the sum is taken on the
    texels of a small lat-long map and interpolated, which is off by at most
    sharpness (pi / rows)^2 / 4 of a lobe's amplitude: 6 % for the sharpest at its very top. It
    starts at radiance about 1/2 from everywhere. Source: Zhang et al. 2021 (PhySG).
    """

    config: EnvmapSGConfig

    def __init__(self, config: EnvmapSGConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or EnvmapSGConfig()
        start = lobes.white_light(config.lobes, config.max_sharpness)
        self.raw: nn.Parameter = nn.Parameter(start.div_(GAIN))  # [K, 7]

    @property
    def radiance(self) -> Tensor:
        return self.latlong(self.config.rows)

    def lobes(self) -> tuple[Tensor, Tensor, Tensor]:
        """Unit axis [K, 3], sharpness [K] and amplitude [K, 3] >= 0."""
        return lobes.decode(GAIN * self.raw, self.config.max_sharpness)

    def latlong(self, height: int) -> Tensor:
        """The map [height, 2 height, 3], linear, in the axes of docs/reference/conventions.md."""
        axis, sharpness, amplitude = self.lobes()
        wi = latlong_directions(height).to(axis).flatten(0, 1)
        exponent = torch.addmm(-sharpness[None], wi, (sharpness[:, None] * axis).T)
        # The floor is nothing beside any light, and spares products too small for normal numbers,
        # over which processors take many times as long
        return (exponent.clamp_min(-40).exp() @ amplitude).view(height, 2 * height, 3)

    def regularisation(self, surface: Surface, near: Surface) -> Regularisation:
        _, sharpness, amplitude = self.lobes()
        # What a lobe sends altogether, over 2 pi
        share = -torch.expm1(-2 * sharpness) / sharpness
        return Regularisation(white_light=priors.chroma((share[:, None] * amplitude).sum(0)[None]))
