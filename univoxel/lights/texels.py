"""One distant light for the whole object: an environment map of texels."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor, nn

from univoxel.lights import latlong, priors
from univoxel.lights.base import MOST_DIRECTIONS, MOST_ROWS, Regularisation
from univoxel.lights.latlong import AbstractLatLongLight, LatLongConfig
from univoxel.records import Surface
from univoxel.validation import check_fields

# The learning rate of networks moves log radiance that much faster: it must reach a sun
GAIN = 30.0
COARSEST = 4  # rows of the coarsest level, at least


@dataclass(frozen=True)
class EnvmapConfig(LatLongConfig):
    """An environment map of texels, with traced visibility."""

    # name of this light, by which config.json tells it from the others
    kind: Literal["envmap"] = field(default="envmap", init=False)
    rows: int = 256  # of the map, twice as wide, >= 1
    directions: int = 64  # of the half-sphere, in training, >= 1
    directions_eval: int = 256  # in evaluation, >= 1

    def __post_init__(self) -> None:
        check_fields(self, "at least 1", lambda x: x >= 1, "rows", "directions", "directions_eval")
        most = f"at most {MOST_DIRECTIONS}"
        check_fields(self, most, lambda x: x <= MOST_DIRECTIONS, "directions", "directions_eval")
        check_fields(self, f"at most {MOST_ROWS}", lambda x: x <= MOST_ROWS, "rows")


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
        self.levels[-1].data += math.log(0.5) / GAIN

    @property
    def log_radiance(self) -> Tensor:
        """[H, 2 H, 3], in the axes of docs/reference/conventions.md."""
        fine, *coarse = self.levels
        total = fine
        for level in coarse:
            total = total + latlong.finer(level, len(fine) // len(level))
        return GAIN * total

    @property
    def radiance(self) -> Tensor:
        return self.log_radiance.exp()

    def regularisation(self, surface: Surface, near: Surface) -> Regularisation:
        log_map = self.log_radiance
        return Regularisation(
            map_smoothness=priors.total_variation(log_map),
            white_light=latlong.chroma(log_map.exp()),
        )

    def latlong(self, height: int) -> Tensor:
        """The map [height, 2 height, 3], linear, in the axes of docs/reference/conventions.md."""
        return latlong.resampled(self.radiance, height)
