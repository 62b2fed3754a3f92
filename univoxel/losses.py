"""What training minimises: plain functions of tensors, each a mean over rays."""

from __future__ import annotations

import torch
from torch import Tensor


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
