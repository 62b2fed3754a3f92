"""Shading under light given for fixed directions of the sphere, and the response to each
direction."""

from __future__ import annotations

import torch
from torch import Tensor

from univoxel import brdf
from univoxel.ops import native
from univoxel.ops.differentiable import check, check_numbers, differentiable


def sizes_of_f0(f0: Tensor | float) -> dict[str, tuple[Tensor, str]]:
    """What ops.checks.check needs to know of it: nothing of a number."""
    return {"f0": (f0, "N 3")} if isinstance(f0, Tensor) else {}


def stored_f0(op: str, f0: Tensor | float, like: Tensor) -> Tensor:
    """[N, 3] as it came, or a number as a tensor [] of the dtype of ``like``.

    Raises:
        TypeError: neither a tensor nor a number.
        ValueError: a number outside [0, 1].
    """
    if isinstance(f0, Tensor):
        return f0
    if not isinstance(f0, int | float):
        raise TypeError(f"{op}: f0 must be a number or a tensor, got {type(f0).__name__}")
    check_numbers(op, "in [0, 1]", f0=f0)
    return like.new_full((), f0)


# Shading under light that is given on fixed directions of the sphere.


def shade_radiance(
    radiance: Tensor,  # [N, D, 3]
    normal: Tensor,  # [N, 3]
    wo: Tensor,  # [N, 3]
    albedo: Tensor,  # [N, 3]
    roughness: Tensor,  # [N]
    directions: Tensor,  # [D, 3]
    solid_angle: float,
    f0: Tensor | float = 0.04,
) -> Tensor:
    """Radiance towards the eye of points that each receive their own light.

        rgb_n = solid_angle sum_d radiance_nd f(w_d, wo_n) max(n.w_d, 0)

    with f the BRDF of docs/reference/conventions.md.

    Args:
        radiance: [N, D, 3] linear, arriving from each direction; light from below the horizon of a
            point does not count.
        normal, wo: [N, 3] unit, world; wo points to the eye.
        albedo: [N, 3] linear, in [0, 1].
        roughness: [N] perceptual, in [0, 1].
        directions: [D, 3] unit, world, over the whole sphere, such as sphere.fibonacci_sphere;
            any number above 0.
        solid_angle: of each direction, steradians; 4 pi / D over the whole sphere.
        f0: reflectance at normal incidence, in [0, 1]: a number, or [N, 3] per channel.

    Returns:
        rgb [N, 3] linear radiance.

    Raises:
        TypeError, ValueError: an argument is not a tensor, or has another size or dtype than above;
            no directions; solid_angle not above 0; f0 a number outside [0, 1].
        NotImplementedError: wo requires grad.

    Differentiable in: radiance, normal (as an arbitrary vector, whose length also matters), albedo,
    roughness, f0 if it is a tensor. Second order raises.
    """
    check(
        "shade_radiance",
        radiance=(radiance, "N D 3"),
        normal=(normal, "N 3"),
        wo=(wo, "N 3"),
        albedo=(albedo, "N 3"),
        roughness=(roughness, "N"),
        directions=(directions, "D 3"),
        **sizes_of_f0(f0),
    )
    _check_rest("shade_radiance", directions, solid_angle, wo=wo)
    reflectance = stored_f0("shade_radiance", f0, like=radiance)
    arguments = (radiance, normal, wo, albedo, roughness, directions.detach())
    if native.serves(radiance):
        contiguous = (a.contiguous() for a in (*arguments, reflectance))
        return _shade_radiance(*contiguous, float(solid_angle))
    return shade_radiance_reference(*arguments, solid_angle, f0)


def shade_map(
    map: Tensor,  # [D, 3]
    visibility: Tensor,  # [P, D]
    indirect: Tensor,  # [P, D, 3]
    index: Tensor,  # [N]
    normal: Tensor,  # [N, 3]
    wo: Tensor,  # [N, 3]
    albedo: Tensor,  # [N, 3]
    roughness: Tensor,  # [N]
    directions: Tensor,  # [D, 3]
    solid_angle: float,
    f0: Tensor | float = 0.04,
) -> Tensor:
    """Radiance towards the eye of points under one distant map that is partly occluded.

        rgb_n = solid_angle sum_d radiance_nd f(w_d, wo_n) max(n.w_d, 0)
        radiance_nd = visibility_pd map_d + indirect_pd,   p = index_n

    Like shade_radiance, but without the [N, D, 3] radiance, which is assembled per sample.

    Args:
        map: [D, 3] linear radiance of the distant light.
        visibility: [P, D] the share of each direction that is open at each of P points: in [0, 1]
            with the dtype of map, or uint8 in 255ths.
        indirect: [P, D, 3] linear radiance from the occluded share, times that share, with the
            dtype of map or float16.
        index: [N] int64 in [0, P), the point of each sample.
        normal, wo, albedo, roughness, directions, solid_angle, f0: as in shade_radiance.

    Returns:
        rgb [N, 3] linear radiance.

    Raises:
        TypeError, ValueError: as in shade_radiance; an index outside [0, P).
        NotImplementedError: visibility, indirect or wo requires grad.

    Differentiable in: map, and normal, albedo, roughness and f0 as in shade_radiance. Second order
    raises.
    """
    as_bytes, as_half = _is(visibility, torch.uint8), _is(indirect, torch.float16)
    check(
        "shade_map",
        map=(map, "D 3"),
        visibility=(visibility, "P D", torch.uint8) if as_bytes else (visibility, "P D"),
        indirect=(indirect, "P D 3", torch.float16) if as_half else (indirect, "P D 3"),
        index=(index, "N", torch.int64),
        normal=(normal, "N 3"),
        wo=(wo, "N 3"),
        albedo=(albedo, "N 3"),
        roughness=(roughness, "N"),
        directions=(directions, "D 3"),
        **sizes_of_f0(f0),
    )
    constants = {"visibility": visibility, "indirect": indirect, "wo": wo}
    _check_rest("shade_map", directions, solid_angle, **constants)
    reflectance = stored_f0("shade_map", f0, like=map)
    arguments = (map, visibility, indirect, index, normal, wo, albedo, roughness)
    arguments = (*arguments, directions.detach())
    if native.serves(map):
        contiguous = (a.contiguous() for a in (*arguments, reflectance))
        return _shade_map(*contiguous, float(solid_angle))
    return shade_map_reference(*arguments, solid_angle, f0)


def _is(argument: object, dtype: torch.dtype) -> bool:
    return isinstance(argument, Tensor) and argument.dtype == dtype


def _check_rest(op: str, directions: Tensor, solid_angle: float, **constants: Tensor) -> None:
    """What sizes and dtypes do not show."""
    if len(directions) == 0:
        raise ValueError(f"{op}: directions must hold at least one direction, got none")
    check_numbers(op, "above 0", solid_angle=solid_angle)
    for name, tensor in constants.items():
        if tensor.requires_grad and torch.is_grad_enabled():
            raise NotImplementedError(f"{op}: gradients for {name} are not supported: detach it")


def shade_radiance_reference(
    radiance: Tensor,
    normal: Tensor,
    wo: Tensor,
    albedo: Tensor,
    roughness: Tensor,
    directions: Tensor,
    solid_angle: float,
    f0: Tensor | float = 0.04,
) -> Tensor:
    """Reference in eager PyTorch."""
    if isinstance(f0, Tensor):
        f0 = f0[:, None]
    surface = (albedo[:, None], roughness[:, None])
    f = brdf.evaluate(normal[:, None], wo[:, None], directions, *surface, f0)
    cosine = (normal[:, None] * directions).sum(-1, keepdim=True).clamp_min(0)
    return solid_angle * (radiance * f * cosine).sum(1)


def shade_map_reference(
    map: Tensor,
    visibility: Tensor,
    indirect: Tensor,
    index: Tensor,
    normal: Tensor,
    wo: Tensor,
    albedo: Tensor,
    roughness: Tensor,
    directions: Tensor,
    solid_angle: float,
    f0: Tensor | float = 0.04,
) -> Tensor:
    """Reference in eager PyTorch; its memory grows with N D."""
    fraction = visibility[index].to(map.dtype)
    if visibility.dtype == torch.uint8:
        fraction = fraction / 255
    radiance = fraction[..., None] * map + indirect[index].to(map.dtype)
    return shade_radiance_reference(
        radiance, normal, wo, albedo, roughness, directions, solid_angle, f0
    )


@differentiable(
    "radiance* normal* wo albedo* roughness* directions f0*",
    "float solid_angle",
    optional="radiance normal",
)
def _shade_radiance(radiance, normal, *_):
    return torch.empty_like(normal)


@differentiable(
    "map* visibility indirect index normal* wo albedo* roughness* directions f0*",
    "float solid_angle",
    optional="map normal",
)
def _shade_map(map, visibility, indirect, index, normal, *_):
    return torch.empty_like(normal)


# What a point would send to the eye of light from each of many directions.


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

    with f of docs/reference/conventions.md. The results are rows of an equation for a light that is
    not known yet, and they are linear in F0.

    Args:
        normal, wo: [N, 3] unit, world; wo points to the eye.
        roughness: [N] perceptual, in [0, 1].
        directions: [D, 3] unit, world.
        solid_angle: of each direction, steradians.
        f0: reflectance at normal incidence, in [0, 1].

    Returns:
        [N, D]; without gradients.

    Raises:
        TypeError, ValueError: an argument has another size, dtype or device than above; solid_angle
            not above 0; f0 outside [0, 1].
    """
    sizes = check(
        "specular_response",
        normal=(normal, "N 3"),
        wo=(wo, "N 3"),
        roughness=(roughness, "N"),
        directions=(directions, "D 3"),
    )
    check_numbers("specular_response", "above 0", solid_angle=solid_angle)
    check_numbers("specular_response", "in [0, 1]", f0=f0)
    if not native.serves(normal):
        return specular_response_reference(normal, wo, roughness, directions, solid_angle, f0)
    response = normal.new_empty(sizes["N"], sizes["D"])
    inputs = [x.contiguous() for x in (normal, wo, roughness, directions)]
    native.call("specular_response", *inputs, response, float(f0), float(solid_angle))
    return response


def specular_response_reference(
    normal: Tensor,
    wo: Tensor,
    roughness: Tensor,
    directions: Tensor,
    solid_angle: float,
    f0: float = 0.04,
) -> Tensor:
    """Reference in eager PyTorch."""
    layer = brdf.specular(normal[:, None], wo[:, None], directions, roughness[:, None], f0)
    return solid_angle * layer * (normal @ directions.T).clamp_min(0)
