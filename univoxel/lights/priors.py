"""What is likely: light and material change little from point to point, light is white on the
whole."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def smoothness(value: Tensor, near: Tensor) -> Tensor:
    """L1 between what holds at surface points and at places right beside them, [N, ...]."""
    return (value - near).abs().mean()


def chroma(light: Tensor) -> Tensor:
    """Mean distance of RGB sums of light [N, 3] from their own grey, relative to the mean grey.

    Images fix albedo and light only up to a colour; a white light on the whole is the likeliest
    guess.
    """
    grey = light.mean(1, keepdim=True)
    return ((light - grey).abs() / grey.detach().mean().clamp_min(1e-6)).mean()


def total_variation(log_map: Tensor) -> Tensor:
    """How much a lat-long map [H, 2 H, 3] goes up and down over the sphere.

        (1 / 4 pi) integral of (1 + |grad log L|^2)^(1/2) - 1 dw,   gradients per radian

    In logarithms, so that a wall counts as much as the sky. About the length of the gradient where
    it is steep, so that noise is dear and the edge of a lamp is not; its square, without a kink,
    where it is even. Source: Rudin, Osher and Fatemi 1992; Charbonnier et al. 1994.
    """
    height, width, _ = log_map.shape
    step = math.pi / height
    elevation = math.pi / 2 - step * (torch.arange(height, device=log_map.device) + 0.5)
    across = elevation.cos()[:, None, None]
    down = torch.nn.functional.pad(log_map.diff(dim=0), (0, 0, 0, 0, 0, 1)) / step
    right = (log_map.roll(-1, 1) - log_map) / (step * across)
    length = (down.square() + right.square() + 1).sqrt() - 1
    return (across * length).sum() / (across.sum() * 3 * width)
