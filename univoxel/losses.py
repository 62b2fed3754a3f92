"""What training minimises: plain functions of tensors, each a mean over rays."""

from __future__ import annotations

import torch
from torch import Tensor


def encode(linear: Tensor) -> Tensor:
    """sRGB curve for losses: as `linear_to_srgb`, but going on above 1, so that a value that is too
    bright still has a gradient."""
    x = linear.clamp_min(0.0)
    curve = 1.055 * x.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(x <= 0.0031308, 12.92 * x, curve)


def photometric(
    encoded: Tensor, target: Tensor, weight: Tensor | None = None, clipped: float = 0.99
) -> Tensor:
    """L1 between sRGB-encoded colours [N, 3].

    A photograph's clipped pixel says only that the light was at least so bright: where the target
    is above `clipped`, overshoot costs nothing.
    """
    over = (target > clipped) & (encoded > target)
    error = torch.where(over, 0.0, (encoded - target).abs()).mean(1)
    return error.mean() if weight is None else (weight * error).sum() / len(error)


def silhouette(opacity: Tensor, alpha: Tensor) -> Tensor:
    """Squared difference of opacity and the photograph's alpha, [N]."""
    return (opacity - alpha).square().mean()
