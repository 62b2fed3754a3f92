"""Light as spherical Gaussians that vary over the surface."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from univoxel import ops, sphere
from univoxel.lights import quadrature
from univoxel.lights.base import AbstractLight
from univoxel.networks import MLP
from univoxel.records import Surface

_MIN_SHARPNESS = 0.1
_FREQUENCIES = 3  # of the position: sines of 1, 2, 4 half-turns over the scale


@dataclass(frozen=True)
class SGConfig:
    """Local spherical Gaussian light."""

    lobes: int = 16  # a point, >= 1
    hidden: int = 64  # width of the head, >= 1
    layers: int = 2  # hidden layers of the head, >= 0
    directions: int = 128  # of the quadrature in training, >= 1
    directions_eval: int = 256  # of the quadrature in evaluation, >= 1
    max_sharpness: float = 30.0  # of a lobe, > 0; its half width is about sqrt(2 / sharpness) rad
    scale: float = 1.0  # world units: half the extent of what is lit, > 0


class LocalSG(AbstractLight):
    """K lobes a point: one global light plus what an MLP adds to it.

        L(w) = sum_k amplitude_k exp(sharpness_k (w . axis_k - 1))

    The lobes hold direct light, indirect light and visibility together, so no rays are traced. They
    start as one white global light of irradiance about pi / 2 under any normal: albedo 0.5 renders
    mid-grey. Source: Wu et al. 2024 (UniVoxel), section 3.3; the sharpness range is InvRender's.
    """

    def __init__(
        self,
        features: int,
        config: SGConfig | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        """
        Args:
            features: C of Surface.features, >= 0.
            generator: draws the head's first weights.

        Raises:
            ValueError: a number outside its range; the message names it.
        """
        super().__init__()
        self.config = config = config or SGConfig()
        for name, least in (
            ("lobes", 1), ("hidden", 1), ("layers", 0), ("directions", 1), ("directions_eval", 1)
        ):  # fmt: skip
            if getattr(config, name) < least:
                raise ValueError(
                    f"SGConfig: {name} must be >= {least}, got {getattr(config, name)}"
                )
        for name in ("max_sharpness", "scale"):
            if not getattr(config, name) > 0:
                raise ValueError(f"SGConfig: {name} must be > 0, got {getattr(config, name)}")
        self.features = features
        sizes = [features + 3 + 6 * _FREQUENCIES, *[config.hidden] * config.layers]
        self.head = MLP([*sizes, 7 * config.lobes], generator or torch.default_generator)
        last = self.head.linear[-1]
        nn.init.zeros_(last.weight)  # the global light is the starting point
        self.base = nn.Parameter(_white_light(config))  # [K, 7]

    def raw(self, surface: Surface) -> Tensor:
        """What the head adds to the global light at each point: [N, 7 K], for smoothness losses."""
        angle = surface.position * (math.pi / self.config.scale)
        waves = [
            w for i in range(_FREQUENCIES) for w in ((angle * 2**i).sin(), (angle * 2**i).cos())
        ]
        position = surface.position / self.config.scale
        return self.head(torch.cat([surface.features, position, *waves], -1))

    def lobes_from_raw(self, raw: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Unit axis [N, K, 3], sharpness [N, K] and amplitude [N, K, 3] >= 0 of deviations."""
        parameters = self.base + raw.unflatten(-1, (self.config.lobes, 7))
        vector, sharpness, amplitude = parameters.split([3, 1, 3], -1)
        # rsqrt of a floored square: a zero vector keeps a finite gradient
        axis = vector * ((vector * vector).sum(-1, keepdim=True).clamp_min(1e-12)).rsqrt()
        sharpness = self.config.max_sharpness * sharpness[..., 0].sigmoid() + _MIN_SHARPNESS
        return axis, sharpness, nn.functional.softplus(amplitude)

    def lobes(self, surface: Surface) -> tuple[Tensor, Tensor, Tensor]:
        """Axis [N, K, 3], sharpness [N, K] and amplitude [N, K, 3] at each point."""
        return self.lobes_from_raw(self.raw(surface))

    def incident(self, surface: Surface, wi: Tensor) -> Tensor:
        """Radiance [N, D, 3] from unit directions wi [N, D, 3]."""
        axis, sharpness, amplitude = self.lobes(surface)
        cosine = torch.einsum("nki,ndi->nkd", axis, wi)
        return torch.einsum("nkd,nkc->ndc", (sharpness[..., None] * (cosine - 1)).exp(), amplitude)

    def reflected(
        self,
        surface: Surface,
        wo: Tensor,
        visibility: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Radiance [N, 3] towards wo; config.directions in training mode, else directions_eval.

        The lobes hold visibility already; where it is given nevertheless, it multiplies them.
        """
        count = self.config.directions if self.training else self.config.directions_eval
        if visibility is not None:
            return quadrature.reflected(self, surface, wo, count, visibility, generator)
        directions = sphere.fibonacci_hemisphere(count, wo.dtype).to(wo.device)
        return ops.shade_sg(
            *self.lobes(surface),
            surface.normal,
            wo,
            surface.albedo,
            surface.roughness,
            directions,
            quadrature.rotations(surface, generator),
        )


def _white_light(config: SGConfig) -> Tensor:
    """Parameters [K, 7] of lobes spread evenly: together radiance about 1/2 from everywhere."""
    k = config.lobes
    # As wide as the lobes lie apart, within the range: the sum is then nearly constant.
    target = min(
        max(k / 2, _MIN_SHARPNESS + 0.05 * config.max_sharpness), 0.8 * config.max_sharpness
    )
    share = (target - _MIN_SHARPNESS) / config.max_sharpness
    # One lobe integrates to 2 pi / s (1 - exp(-2 s)) over the sphere; the mean radiance is K times
    # that over 4 pi.
    amplitude = 0.5 * 2 * target / (k * -math.expm1(-2 * target))
    axis = sphere.fibonacci_sphere(k)
    sharpness = torch.full((k, 1), math.log(share / (1 - share)))
    return torch.cat([axis, sharpness, torch.full((k, 3), math.log(math.expm1(amplitude)))], -1)
