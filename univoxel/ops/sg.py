"""Spherical Gaussians: decoding of lobes, and shading by quadrature over the hemisphere."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from univoxel import brdf, sphere
from univoxel.ops import native
from univoxel.ops.differentiable import check, check_numbers, differentiable
from univoxel.ops.shade import sizes_of_f0, stored_f0

SHORTEST = 1e-12  # squared length of a vector, below which its axis is shorter than 1


def decode_lobes(
    parameters: Tensor,  # [M, 7]
    min_sharpness: float,
    max_sharpness: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Decode lobes from unconstrained numbers.

        axis = v / |v|,   sharpness = min + max S(s),   amplitude = log(1 + exp(a))

    with S the sigmoid and (v, s, a) the three, one and three numbers of a lobe.

    Args:
        parameters: [M, 7] any numbers: three for the axis, one for the sharpness, three for the
            amplitude; any number of lobes.
        min_sharpness: at least 0.
        max_sharpness: above 0; the most that is added to min_sharpness.

    Returns:
        axis [M, 3] unit, sharpness [M] and amplitude [M, 3] >= 0. If a vector is shorter than 1e-6,
        its axis is shorter than 1, so that the gradient stays finite.

    Raises:
        TypeError, ValueError: parameters is no tensor, or of another size or dtype than above; a
            number out of range.

    Differentiable in: parameters. Second order raises.
    """
    check("decode_lobes", parameters=(parameters, "M 7"))
    check_numbers("decode_lobes", "at least 0", min_sharpness=min_sharpness)
    check_numbers("decode_lobes", "above 0", max_sharpness=max_sharpness)
    if native.serves(parameters):
        return _decode_lobes(parameters.contiguous(), float(min_sharpness), float(max_sharpness))
    return decode_lobes_reference(parameters, min_sharpness, max_sharpness)


def decode_lobes_reference(
    parameters: Tensor, min_sharpness: float, max_sharpness: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Reference in eager PyTorch."""
    vector, sharpness, amplitude = parameters.split([3, 1, 3], -1)
    axis = vector * (vector * vector).sum(-1, keepdim=True).clamp_min(SHORTEST).rsqrt()
    sharpness = min_sharpness + max_sharpness * sharpness[..., 0].sigmoid()
    # softplus without its threshold
    return axis, sharpness, -torch.nn.functional.logsigmoid(-amplitude)


def _forward(tensors: Sequence, options: Sequence, outputs: Sequence[Tensor]) -> None:
    native.call("decode_lobes_forward", *tensors, *options, *outputs)


def _backward(
    saved: Sequence, grads: Sequence[Tensor], options: Sequence, _: list[bool]
) -> list[Tensor]:
    grad = torch.empty_like(saved[0])
    native.call("decode_lobes_backward", *saved, *options, *grads, grad)
    return [grad]


@differentiable(
    "parameters*",
    "float min_sharpness, float max_sharpness",
    outputs=3,
    forward=_forward,
    backward=_backward,
)
def _decode_lobes(parameters, *_):
    m = len(parameters)
    return parameters.new_empty(m, 3), parameters.new_empty(m), parameters.new_empty(m, 3)


# Shading under spherical Gaussian light, by quadrature over the half-sphere.


def shade_sg(
    axis: Tensor,  # [N, K, 3]
    sharpness: Tensor,  # [N, K]
    amplitude: Tensor,  # [N, K, 3]
    normal: Tensor,  # [N, 3]
    wo: Tensor,  # [N, 3]
    albedo: Tensor,  # [N, 3]
    roughness: Tensor,  # [N]
    directions: Tensor,  # [D, 3]
    rotation: Tensor,  # [N]
    f0: Tensor | float = 0.04,
) -> Tensor:
    """Radiance towards the eye of points lit by K spherical Gaussians each.

        rgb = (2 pi / D) sum_d L(w_d) f(w_d, wo) max(n.w_d, 0)
        L(w) = sum_k amplitude_k exp(sharpness_k (w.axis_k - 1))

    with f the BRDF of docs/reference/conventions.md and w_d the directions, rotated about +Z by
    `rotation` and transformed into the frame of the normal (sphere.frame).

    Args:
        axis: [N, K, 3] unit, world; any number of lobes.
        sharpness: [N, K] >= 0; 0 is light from everywhere.
        amplitude: [N, K, 3] linear radiance at the axis.
        normal, wo: [N, 3] unit, world; wo points to the eye.
        albedo: [N, 3] linear, in [0, 1].
        roughness: [N] perceptual, in [0, 1].
        directions: [D, 3] unit, around +Z, of equal solid angle, such as
            sphere.fibonacci_hemisphere; any number above 0.
        rotation: [N] radians; random rotations replace the pattern of a fixed set by noise.
        f0: reflectance at normal incidence, in [0, 1]: a number, or [N, 3] per channel.

    Returns:
        rgb [N, 3] linear radiance.

    Raises:
        TypeError, ValueError: an argument is not a tensor, or has another size or dtype than above;
            no directions; f0 a number outside [0, 1].

    Differentiable in: axis, sharpness, amplitude, normal (the directions rotate with it), wo,
    albedo, roughness, f0 if it is a tensor. Second order raises.
    """
    sizes = check(
        "shade_sg",
        axis=(axis, "N K 3"),
        sharpness=(sharpness, "N K"),
        amplitude=(amplitude, "N K 3"),
        normal=(normal, "N 3"),
        wo=(wo, "N 3"),
        albedo=(albedo, "N 3"),
        roughness=(roughness, "N"),
        directions=(directions, "D 3"),
        rotation=(rotation, "N"),
        **sizes_of_f0(f0),
    )
    if sizes["D"] == 0:
        raise ValueError("shade_sg: directions must hold at least one direction, got none")
    reflectance = stored_f0("shade_sg", f0, like=axis)
    lobes = (axis, sharpness, amplitude)
    arguments = (*lobes, normal, wo, albedo, roughness, directions.detach(), rotation.detach())
    if native.serves(axis):
        return _shade_sg(*(a.contiguous() for a in (*arguments, reflectance)))
    return shade_sg_reference(*arguments, f0)


def shade_sg_reference(
    axis: Tensor,
    sharpness: Tensor,
    amplitude: Tensor,
    normal: Tensor,
    wo: Tensor,
    albedo: Tensor,
    roughness: Tensor,
    directions: Tensor,
    rotation: Tensor,
    f0: Tensor | float = 0.04,
) -> Tensor:
    """Reference in eager PyTorch, in the frame of each normal, where the normal is +Z."""
    to_local = torch.stack([*sphere.frame(normal), normal], 1)
    axis = torch.einsum("nij,nkj->nki", to_local, axis)
    wo = torch.einsum("nij,nj->ni", to_local, wo)[:, None]
    wi = sphere.rotate_z(directions, rotation[:, None])
    lobe = (sharpness[..., None] * (torch.einsum("nki,ndi->nkd", axis, wi) - 1)).exp()
    radiance = torch.einsum("nkd,nkc->ndc", lobe, amplitude)
    up = wi.new_tensor([0.0, 0.0, 1.0])
    if isinstance(f0, Tensor):
        f0 = f0[:, None]
    f = brdf.evaluate(up, wo, wi, albedo[:, None], roughness[:, None], f0)
    cosine = wi[..., 2:].clamp_min(0)
    return (2 * math.pi / len(directions)) * (radiance * f * cosine).sum(1)


@differentiable(
    "axis* sharpness* amplitude* normal* wo* albedo* roughness* directions rotation f0*"
)
def _shade_sg(axis, sharpness, amplitude, normal, *_):
    return torch.empty_like(normal)
