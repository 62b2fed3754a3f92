"""The sRGB transfer function and its slope: computations are linear, images are sRGB."""

from __future__ import annotations

import torch
from torch import Tensor

LINEAR_END = 0.0031308  # linear value up to which the curve is a line


def linear_to_srgb(linear: Tensor) -> Tensor:
    """IEC 61966-2-1 encoding of linear values in [0, 1]; others are clipped first.

    Differentiable where 0 < linear < 1.
    """
    return _srgb_curve(linear.clamp(0.0, 1.0))


def linear_to_srgb_unclipped(linear: Tensor) -> Tensor:
    """`linear_to_srgb` that continues above 1: a value that is too bright still has a gradient."""
    return _srgb_curve(linear.clamp_min(0.0))


def srgb_slope(linear: Tensor) -> Tensor:
    """Derivative of `linear_to_srgb_unclipped` at linear values >= 0."""
    power = 1.055 / 2.4 * linear.clamp_min(LINEAR_END) ** (1 / 2.4 - 1)
    return torch.where(linear <= LINEAR_END, 12.92, power)


def _srgb_curve(x: Tensor) -> Tensor:
    # The power's slope is infinite at 0; the clamp keeps its unused branch finite in the backward.
    power = 1.055 * x.clamp_min(LINEAR_END) ** (1 / 2.4) - 0.055
    return torch.where(x <= LINEAR_END, 12.92 * x, power)


def srgb_to_linear(srgb: Tensor) -> Tensor:
    """IEC 61966-2-1 decoding of values in [0, 1]: the piecewise curve, not a power of 2.2."""
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def luminance(linear: Tensor) -> Tensor:
    """Rec. 709 luminance of linear RGB in the last dimension: [..., 3] -> [...]."""
    return linear @ linear.new_tensor([0.2126, 0.7152, 0.0722])


CLIPPED = 0.97  # sRGB; brighter pixels are lower bounds
