"""The sRGB transfer function: linear radiance inside, sRGB in pictures."""

from __future__ import annotations

import torch
from torch import Tensor


def linear_to_srgb(linear: Tensor) -> Tensor:
    """IEC 61966-2-1 encoding of linear values in [0, 1]; others are clipped first.

    Differentiable where 0 < linear < 1.
    """
    x = linear.clamp(0.0, 1.0)
    # The power's slope is infinite at 0; the clamp keeps its unused branch finite in the backward.
    return torch.where(
        x <= 0.0031308, 12.92 * x, 1.055 * x.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
    )


def srgb_to_linear(srgb: Tensor) -> Tensor:
    """IEC 61966-2-1 decoding of values in [0, 1]: the piecewise curve, not a power of 2.2."""
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def luminance(linear: Tensor) -> Tensor:
    """Rec. 709 luminance of linear RGB in the last dimension: [..., 3] -> [...]."""
    return linear @ linear.new_tensor([0.2126, 0.7152, 0.0722])


CLIPPED = 0.97  # sRGB; brighter pixels are lower bounds
