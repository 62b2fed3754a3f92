"""Spherical Gaussians from numbers without limits, as networks give them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from univoxel.ops import native
from univoxel.ops.checks import check
from univoxel.ops.differentiable import differentiable

SHORTEST = 1e-12  # squared length of a vector, below which its axis is shorter than 1


def decode_lobes(
    parameters: Tensor,  # [M, 7]
    min_sharpness: float,
    max_sharpness: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Make lobes of numbers without limits.

        axis = v / |v|,   sharpness = min + max S(s),   amplitude = log(1 + exp(a))

    with S the sigmoid and (v, s, a) the three, one and three numbers of a lobe.

    Args:
        parameters: [M, 7] any numbers: three for the axis, one for the sharpness, three for the
            amplitude; any number of lobes.
        min_sharpness: at least 0.
        max_sharpness: above 0; what is added to it at most.

    Returns:
        axis [M, 3] unit, sharpness [M] and amplitude [M, 3] >= 0. The axis of a vector shorter than
        1e-6 is shorter than 1: so its gradient stays finite.

    Raises:
        TypeError, ValueError: parameters is no tensor, or of another size or dtype than above; a
            number out of range.

    Differentiable in: parameters. Second order raises.
    """
    check("decode_lobes", parameters=(parameters, "M 7"))
    if not 0 <= min_sharpness < math.inf:
        raise ValueError(f"decode_lobes: min_sharpness must be at least 0, got {min_sharpness}")
    if not 0 < max_sharpness < math.inf:
        raise ValueError(f"decode_lobes: max_sharpness must be above 0, got {max_sharpness}")
    if native.serves(parameters):
        return _decode_lobes(parameters.contiguous(), float(min_sharpness), float(max_sharpness))
    return decode_lobes_reference(parameters, min_sharpness, max_sharpness)


def decode_lobes_reference(
    parameters: Tensor, min_sharpness: float, max_sharpness: float
) -> tuple[Tensor, Tensor, Tensor]:
    """The same in eager torch."""
    vector, sharpness, amplitude = parameters.split([3, 1, 3], -1)
    axis = vector * (vector * vector).sum(-1, keepdim=True).clamp_min(SHORTEST).rsqrt()
    sharpness = min_sharpness + max_sharpness * sharpness[..., 0].sigmoid()
    # softplus without its threshold
    return axis, sharpness, -torch.nn.functional.logsigmoid(-amplitude)


def _forward(tensors: Sequence, options: Sequence, outputs: Sequence[Tensor]) -> None:
    parameters, *lobes = native.arrays(*tensors, *outputs)
    native.require().decode_lobes_forward(parameters, *options, *lobes, native.threads())


def _backward(
    saved: Sequence, grads: Sequence[Tensor], options: Sequence, _: list[bool]
) -> list[Tensor]:
    grad = torch.empty_like(saved[0])
    parameters, *others = native.arrays(*saved, *grads, grad)
    native.require().decode_lobes_backward(parameters, *options, *others, native.threads())
    return [grad]


@differentiable(to="parameters", forward=_forward, backward=_backward)
def _decode_lobes(
    parameters: Tensor, min_sharpness: float, max_sharpness: float
) -> tuple[Tensor, Tensor, Tensor]:
    m = len(parameters)
    return parameters.new_empty(m, 3), parameters.new_empty(m), parameters.new_empty(m, 3)
