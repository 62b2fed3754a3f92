"""One distant light for the whole object: an environment map of texels, or of spherical
Gaussians."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor, nn

from univoxel.core.records import Surface
from univoxel.core.validation import check_settings, setting
from univoxel.lights import base, latlong, sg
from univoxel.lights.base import KIND, MOST_DIRECTIONS, MOST_ROWS, Regularisation
from univoxel.lights.latlong import AbstractLatLongLight
from univoxel.sphere import latlong_directions

# The learning rate of networks moves log radiance that much faster: it must reach a sun
TEXEL_GAIN = 30.0
COARSEST = 4  # rows of the coarsest level, at least


@dataclass(frozen=True)
class EnvmapConfig:
    """An environment map of texels, with traced visibility."""

    kind: Literal["envmap"] = field(default="envmap", init=False, metadata=KIND)
    rows: int = setting(256, "number of rows of the map", least=1, most=MOST_ROWS)
    directions: int = setting(64, "directions in training", least=1, most=MOST_DIRECTIONS)
    directions_eval: int = setting(256, "directions in evaluation", least=1, most=MOST_DIRECTIONS)

    __post_init__ = check_settings


class EnvmapLight(AbstractLatLongLight):
    """Radiance at the texels of a lat-long map, interpolated bilinearly between them.

        log L = GAIN sum_l up(level_l)

    Kept as logarithm, so that it stays positive and a bright sun is as far away as a dark wall; and
    as a sum of levels, each four times as coarse as the one before and interpolated between its
    texels. A step of Adam moves all parameters about equally far: the coarse ones bring whole parts
    of the sky along, the fine ones what they leave. It starts at radiance 1/2 from everywhere.
    """

    config: EnvmapConfig

    def __init__(self, config: EnvmapConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or EnvmapConfig()
        rows = [config.rows]
        while rows[-1] % 4 == 0 and rows[-1] >= 4 * COARSEST:
            rows.append(rows[-1] // 4)
        self.levels: nn.ParameterList = nn.ParameterList(
            torch.zeros(r, 2 * r, 3) for r in rows
        )  # fine to coarse
        self.levels[-1].data += math.log(0.5) / TEXEL_GAIN

    @property
    def log_radiance(self) -> Tensor:
        """[H, 2 H, 3], in the axes of docs/reference/conventions.md."""
        fine, *coarse = self.levels
        total = fine
        for level in coarse:
            total = total + latlong.finer(level, len(fine) // len(level))
        return TEXEL_GAIN * total

    @property
    def radiance(self) -> Tensor:
        return self.log_radiance.exp()

    def regularisation(self, surface: Surface, near: Surface) -> Regularisation:
        log_map = self.log_radiance
        return Regularisation(
            map_smoothness=base.total_variation(log_map), white_light=latlong.chroma(log_map.exp())
        )

    def latlong(self, height: int) -> Tensor:
        """The map [height, 2 height, 3], linear, in the axes of docs/reference/conventions.md."""
        return latlong.resampled(self.radiance, height)


# One distant light for the whole object: an environment map of spherical Gaussians.


LOBE_GAIN = (
    10.0  # the learning rate of networks moves the lobes that much faster: they must reach a sun
)


@dataclass(frozen=True)
class EnvmapSGConfig:
    """An environment map of spherical Gaussians, with traced visibility."""

    kind: Literal["envmap-sg"] = field(default="envmap-sg", init=False, metadata=KIND)
    lobes: int = setting(128, "number of lobes", least=1)
    max_sharpness: float = setting(
        100.0, "maximum sharpness of a lobe; the half width is sqrt(2 / sharpness) rad", above=0
    )
    rows: int = setting(
        64, "number of rows of the map that the lobes are rendered to", least=1, most=MOST_ROWS
    )
    directions: int = setting(64, "directions in training", least=1, most=MOST_DIRECTIONS)
    directions_eval: int = setting(256, "directions in evaluation", least=1, most=MOST_DIRECTIONS)

    __post_init__ = check_settings


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
        start = sg.white_light(config.lobes, config.max_sharpness)
        self.raw: nn.Parameter = nn.Parameter(start.div_(LOBE_GAIN))  # [K, 7]

    @property
    def radiance(self) -> Tensor:
        return self.latlong(self.config.rows)

    def lobes(self) -> tuple[Tensor, Tensor, Tensor]:
        """Unit axis [K, 3], sharpness [K] and amplitude [K, 3] >= 0."""
        return sg.decode(LOBE_GAIN * self.raw, self.config.max_sharpness)

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
        return Regularisation(white_light=base.chroma((share[:, None] * amplitude).sum(0)[None]))
