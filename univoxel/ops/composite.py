"""Volume-render compositing of packed rays."""

from __future__ import annotations

import torch
from torch import Tensor

from univoxel.ops import native
from univoxel.ops.checks import check
from univoxel.ops.differentiable import differentiable


def composite(
    alpha: Tensor,  # [M]
    value: Tensor,  # [M, C]
    offsets: Tensor,  # [N + 1]
    early_stop: float = 0.0,
) -> tuple[Tensor, Tensor]:
    """Composite values along packed rays, front to back.

        T_i = prod_{j < i} (1 - alpha_j),   weight_i = alpha_i T_i,   out_n = sum_i weight_i value_i

    with i over the samples offsets[n] .. offsets[n + 1] of ray n.

    Args:
        alpha: [M] opacity of each sample, in [0, 1].
        value: [M, C] what is composited: any number of channels.
        offsets: [N + 1] int64, rising from 0 to M; ray n owns samples offsets[n] .. offsets[n + 1].
        early_stop: a ray ends where its transmittance falls below this, in [0, 1]; later samples
            weigh 0 and get no gradient. 0 never ends a ray early.

    Returns:
        out [N, C] and weight [M]. The opacity of a ray is the sum of its weights.

    Raises:
        TypeError, ValueError: an argument is no tensor, or of another size, dtype or device than
            above; offsets do not rise from 0 to M; early_stop outside [0, 1].

    Differentiable in: alpha, value. Second order raises.
    Source: Max 1995, "Optical models for direct volume rendering", in the discrete form of
    Mildenhall et al. 2020 (NeRF), eq. 3.
    """
    check(
        "composite",
        alpha=(alpha, "M"),
        value=(value, "M C"),
        offsets=(offsets, "N+1", torch.int64),
    )
    if not 0.0 <= early_stop <= 1.0:
        raise ValueError(f"composite: early_stop must be in [0, 1], got {early_stop}")
    if native.serves(alpha):
        return _composite(
            alpha.contiguous(), value.contiguous(), offsets.contiguous(), float(early_stop)
        )
    return composite_reference(alpha, value, offsets, early_stop)


def composite_reference(
    alpha: Tensor, value: Tensor, offsets: Tensor, early_stop: float = 0.0
) -> tuple[Tensor, Tensor]:
    """The same in eager torch: rays padded to the longest, autograd gives the backward."""
    counts = offsets.diff()
    ray = torch.repeat_interleave(counts)
    slot = torch.arange(len(alpha), device=alpha.device) - offsets[ray]
    longest = int(counts.max()) if len(counts) else 0
    padded = alpha.new_zeros(len(counts), longest).index_put((ray, slot), alpha)
    through = torch.cumprod(1 - padded, 1)
    trans = torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], 1)[ray, slot]
    weight = torch.where(trans < early_stop, 0.0, trans * alpha)
    out = value.new_zeros(len(counts), value.shape[1]).index_add(0, ray, weight[:, None] * value)
    return out, weight


@differentiable(to="alpha value")
def _composite(
    alpha: Tensor, value: Tensor, offsets: Tensor, early_stop: float
) -> tuple[Tensor, Tensor]:
    return value.new_empty(len(offsets) - 1, value.shape[1]), torch.empty_like(alpha)
