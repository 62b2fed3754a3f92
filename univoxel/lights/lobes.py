"""Spherical Gaussians as numbers without limits, for whichever light is made of them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from univoxel import sphere
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
