"""Local light as spherical Gaussians."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from univoxel import brdf, ops, sphere
from univoxel.core.records import Occlusion, Surface
from univoxel.core.validation import check_settings, setting
from univoxel.lights import base, quadrature
from univoxel.lights.base import (
    KIND,
    MOST_DIRECTIONS,
    MOST_LAYERS,
    AbstractLocalLight,
    LocalLightConfig,
    Regularisation,
)
from univoxel.ops import decode_lobes

_MIN_SHARPNESS = 0.1


def decode(parameters: Tensor, max_sharpness: float) -> tuple[Tensor, Tensor, Tensor]:
    """Unit axis [..., K, 3], sharpness [..., K] and amplitude [..., K, 3] >= 0.

    Args:
        parameters: [..., K, 7] any numbers: three for the axis, one for the sharpness, three for
            the amplitude.
    """
    *leading, count, numbers = parameters.shape
    flat = parameters.reshape(-1, numbers)
    axis, sharpness, amplitude = decode_lobes(flat, _MIN_SHARPNESS, max_sharpness)
    shape = *leading, count
    return axis.view(*shape, 3), sharpness.view(shape), amplitude.view(*shape, 3)


def white_light(count: int, max_sharpness: float) -> Tensor:
    """Parameters [K, 7] of lobes spread evenly: together radiance about 1/2 from everywhere."""
    # As wide as the lobes lie apart, within the range: the sum is then nearly constant.
    target = min(max(count / 2, _MIN_SHARPNESS + 0.05 * max_sharpness), 0.8 * max_sharpness)
    share = (target - _MIN_SHARPNESS) / max_sharpness
    # One lobe integrates to 2 pi / s (1 - exp(-2 s)) over the sphere; the mean radiance is K times
    # that over 4 pi.
    amplitude = 0.5 * 2 * target / (count * -math.expm1(-2 * target))
    parameters = torch.empty(count, 7)
    parameters[:, :3] = sphere.fibonacci_sphere(count)
    parameters[:, 3] = math.log(share / (1 - share))
    parameters[:, 4:] = math.log(math.expm1(amplitude))
    return parameters


@dataclass(frozen=True)
class SGConfig(LocalLightConfig):
    """Local spherical Gaussian light."""

    kind: Literal["sg"] = field(default="sg", init=False, metadata=KIND)
    lobes: int = setting(16, "lobes per point", least=1)
    hidden: int = setting(64, "width of the head", least=1)
    layers: int = setting(2, "number of hidden layers of the head", least=0, most=MOST_LAYERS)
    directions: int = setting(64, "directions in training", least=1, most=MOST_DIRECTIONS)
    directions_eval: int = setting(256, "directions in evaluation", least=1, most=MOST_DIRECTIONS)
    max_sharpness: float = setting(
        30.0, "maximum sharpness of a lobe; the half width is sqrt(2 / sharpness) rad", above=0
    )
    scale: float = setting(1.0, "half the longest side of the box", unit="world units", above=0)

    __post_init__ = check_settings


class LocalSG(AbstractLocalLight):
    """K lobes a point: one global light plus what an MLP adds to it.

        L(w) = sum_k amplitude_k exp(sharpness_k (w . axis_k - 1))

    The lobes hold direct light, indirect light and visibility together, so no rays are traced. They
    start as one white global light of irradiance about pi / 2 under any normal: albedo 0.5 renders
    mid-grey. Source: Wu et al. 2024 (UniVoxel), section 3.3; the sharpness range is InvRender's.
    """

    config: SGConfig

    def __init__(
        self,
        features: int,
        config: SGConfig | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        """Arguments as of `AbstractLocalLight`."""
        config = config or SGConfig()
        start = white_light(config.lobes, config.max_sharpness)  # [K, 7]
        super().__init__(features, config, start, generator)

    def lobes_from_raw(self, raw: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Unit axis [N, K, 3], sharpness [N, K] and amplitude [N, K, 3] >= 0 of deviations."""
        parameters = self.base + raw.unflatten(-1, (self.config.lobes, 7))
        return decode(parameters, self.config.max_sharpness)

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
        occlusion: Occlusion | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Radiance [N, 3] towards wo; config.directions in training mode, else directions_eval."""
        if occlusion is not None:
            return quadrature.reflected(self, surface, wo, self.directions, occlusion, generator)
        directions = sphere.fibonacci_hemisphere(self.directions, wo.dtype).to(wo.device)
        diffuse, f0 = brdf.split(surface.albedo, surface.metallic)
        return ops.shade_sg(
            *self.lobes(surface),
            surface.normal,
            wo,
            diffuse,
            surface.roughness,
            directions,
            quadrature.rotations(surface, generator),
            f0,
        )

    def regularisation(self, surface: Surface, near: Surface) -> Regularisation:
        raw = self.raw(surface)
        _, _, amplitude = self.lobes_from_raw(raw)
        return Regularisation(
            light_smoothness=base.smoothness(raw, self.raw(near)),
            white_light=base.chroma(amplitude.sum(1)),
        )
