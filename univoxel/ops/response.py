"""What a point would send to the eye of light from each of many directions."""

from __future__ import annotations

import torch
from torch import Tensor

from univoxel import brdf
from univoxel.ops import native
from univoxel.ops.checks import check


@torch.no_grad()
def specular_response(
    normal: Tensor,  # [N, 3]
    wo: Tensor,  # [N, 3]
    roughness: Tensor,  # [N]
    directions: Tensor,  # [D, 3]
    solid_angle: float,
    f0: float = 0.04,
) -> Tensor:
    """Radiance towards the eye by the specular layer, for unit radiance from each direction.

        response_nd = solid_angle f_specular(w_d, wo_n) max(n.w_d, 0)

    with f of docs/reference/conventions.md. These are rows of an equation for a light that is not
    known yet. Linear in F0.

    Args:
        normal, wo: [N, 3] unit, world; wo points to the eye.
        roughness: [N] perceptual, in [0, 1].
        directions: [D, 3] unit, world.
        solid_angle: of each direction, steradians.
        f0: reflectance at normal incidence, in [0, 1].

    Returns:
        [N, D]; without gradients.

    Raises:
        TypeError, ValueError: an argument of another size, dtype or device than above; solid_angle
            not above 0; f0 outside [0, 1].
    """
    sizes = check(
        "specular_response",
        normal=(normal, "N 3"),
        wo=(wo, "N 3"),
        roughness=(roughness, "N"),
        directions=(directions, "D 3"),
    )
    if not solid_angle > 0:
        raise ValueError(f"specular_response: solid_angle must be above 0, got {solid_angle}")
    if not 0 <= f0 <= 1:
        raise ValueError(f"specular_response: f0 must be in [0, 1], got {f0}")
    if not native.serves(normal):
        return specular_response_reference(normal, wo, roughness, directions, solid_angle, f0)
    response = normal.new_empty(sizes["N"], sizes["D"])
    inputs = [x.contiguous() for x in (normal, wo, roughness, directions)]
    options = float(f0), float(solid_angle), native.threads()
    native.require().specular_response(*native.arrays(*inputs, response), *options)
    return response


def specular_response_reference(
    normal: Tensor,
    wo: Tensor,
    roughness: Tensor,
    directions: Tensor,
    solid_angle: float,
    f0: float = 0.04,
) -> Tensor:
    """The same in eager torch."""
    layer = brdf.specular(normal[:, None], wo[:, None], directions, roughness[:, None], f0)
    return solid_angle * layer * (normal @ directions.T).clamp_min(0)
