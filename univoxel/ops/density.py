"""From signed distances to opacity."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid


def section_alpha(sdf: Tensor, connected: Tensor, inv_s: float) -> Tensor:
    """Opacity of the sections that start at packed samples.

        alpha_i = max(0, 1 - sigmoid(f_{i+1} / s) / sigmoid(f_i / s))

    from the sdf at both ends of the section: nothing is assumed of the slope in between. Taken as a
    difference of logarithms, it neither cancels nor divides by zero deep inside.

    Args:
        sdf: [M] world units.
        connected: [M] bool, whether sample i + 1 ends the section that starts at i.
        inv_s: 1 / s, 1 / world units.

    Returns:
        [M] in [0, 1]; 0 where no section starts.

    Source: Wang et al. 2021 (NeuS), eq. 13.
    """
    log_phi = logsigmoid(sdf * inv_s)
    fall = (log_phi.roll(-1) - log_phi).clamp_max(0)
    return torch.where(connected, -torch.expm1(fall), 0.0)
