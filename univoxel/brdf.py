"""The BRDF of docs/reference/conventions.md: a GGX layer over a Lambertian base.

Directions are unit vectors [..., 3] that broadcast against each other; cosines and materials are
[...]; F0 is a number, or [..., 3] per channel, and then what depends on it has channels too. ``wo``
points to the eye, ``wi`` to the light. Everything is differentiable and finite, in value and
gradient, for any normal (zero too), any pair of directions and roughness in [0, 1]: cosines to the
eye and the light are held above 1e-4, so an eye behind the surface shades as at grazing view, and
light from behind the surface adds nothing.
"""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor

ALPHA_MIN = 1e-3  # smallest GGX alpha: below, a highlight is narrower than any quadrature
COS_MIN = 1e-4  # cosines in denominators are held above this
F0 = 0.04  # reflectance of dielectrics at normal incidence
_HALF_EPSILON = 1e-7  # added to |wi + wo|^2, which is 0 where the light is opposite the eye

# E with F0 = 0 and with F0 = 1 as polynomials of total degree 4 in cosine, roughness and
# u = cosine / (cosine + alpha); u follows the boundary layer of Smith's masking at grazing view.
# Minimax fit to quadrature over visible normals, on cosine in [0.02, 1] and roughness in [0.05, 1].
_EXPONENTS = [e for e in itertools.product(range(5), repeat=3) if sum(e) <= 4]
# fmt: off
_ALBEDO_BLACK = [
    0.745523, 2.79565, -8.54429, 10.4028, -4.40541, -2.03631, -3.23016, 5.87168, -1.51822,
    2.34881, -10.8813, 28.1217, -1.20787, 31.7152, 0.18939, -5.392, 5.48925, -22.6324,
    17.9447, 3.53936, -28.1758, 25.3064, -25.0208, 5.48368, 6.23112, 9.27461, 3.79092,
    -4.89692, 5.30421, -3.44505, -1.23944, -2.04994, -4.57074, -1.07901, 2.02599,
]
_ALBEDO_WHITE = [
    0.724531, -0.74156, 1.75763, -0.0237653, -0.714459, 1.22618, 14.7944, -35.535, 19.52,
    -2.26108, -44.7913, 76.4906, 2.05057, 90.465, -0.773033, -13.8655, 30.9258, -45.5647,
    28.4446, 5.73739, -84.7276, 77.534, -79.2618, 69.526, 24.9903, 23.2341, -46.2919, 23.344,
    -6.60739, 9.15137, -7.20615, 7.20929, -7.59783, -0.86621, 0.162265,
]
# fmt: on


def split(base: Tensor, metallic: Tensor | None) -> tuple[Tensor, Tensor | float]:
    """Diffuse albedo [..., 3] and F0 of a base colour, as glTF defines them.

        diffuse = base (1 - metallic),  F0 = 0.04 (1 - metallic) + base metallic

    Args:
        base: [..., 3] linear, in [0, 1].
        metallic: [...] in [0, 1]; None is 0 everywhere.

    Returns:
        The diffuse albedo, and F0 as [..., 3], or the number 0.04 where metallic is None.

    Differentiable in: base, metallic.
    Source: Khronos Group, glTF 2.0 Specification, appendix B.
    """
    if metallic is None:
        return base, F0
    m = metallic[..., None]
    return base * (1 - m), F0 * (1 - m) + base * m


def metal_or_none(metallic: Tensor | None) -> Tensor | None:
    """Metallic [...], or None if no value of it would show in 8 bits: a dielectric scene."""
    return metallic if metallic is not None and (metallic > 0.5 / 255).any() else None


def ggx_alpha(roughness: Tensor) -> Tensor:
    """GGX alpha = roughness^2, at least 1e-3."""
    return (roughness * roughness).clamp_min(ALPHA_MIN)


def ggx_d(n_dot_h_squared: Tensor, n_cross_h_squared: Tensor, alpha: Tensor) -> Tensor:
    """GGX normal distribution: D = alpha^2 / (pi (|n x h|^2 + alpha^2 (n.h)^2)^2).

    The two squares come apart because 1 - (n.h)^2 cancels in float32. Integrates to 1 over the
    half-sphere with weight n.h. Source: Walter et al. 2007, eq. 33.
    """
    a2 = alpha * alpha
    # The denominator is at least alpha^2 for a unit h; half of it guards a missing half vector.
    denominator = torch.maximum(n_cross_h_squared + a2 * n_dot_h_squared, 0.5 * a2)
    return a2 / (math.pi * denominator * denominator)


def smith_v(n_dot_v: Tensor, n_dot_l: Tensor, alpha: Tensor) -> Tensor:
    """Height-correlated Smith masking-shadowing over 4 (n.v)(n.l). Source: Heitz 2014, eq. 99."""
    a2 = alpha * alpha
    v, light = n_dot_v.clamp_min(COS_MIN), n_dot_l.clamp_min(COS_MIN)
    masking = light * (v * v * (1 - a2) + a2).sqrt()
    shadowing = v * (light * light * (1 - a2) + a2).sqrt()
    return 0.5 / (masking + shadowing)


def schlick_f(v_dot_h: Tensor, f0: Tensor | float) -> Tensor:
    """Fresnel reflectance F0 + (1 - F0) (1 - v.h)^5. Source: Schlick 1994, eq. 15."""
    return f0 + (1 - f0) * (1 - v_dot_h) ** 5


def specular(
    normal: Tensor,  # [..., 3]
    wo: Tensor,  # [..., 3]
    wi: Tensor,  # [..., 3]
    roughness: Tensor,  # [...] in [0, 1]
    f0: Tensor | float = F0,  # a tensor is [..., 3]
) -> Tensor:
    """The specular layer D F V, without the cosine: [...] or, as F0, [..., 3]; 0 for n.wi <= 0.

    For unit directions wo.h = |wi + wo| / 2, which needs no division.
    """
    alpha = ggx_alpha(roughness)
    half = wi + wo
    squared = (half * half).sum(-1) + _HALF_EPSILON
    n_dot_h_squared = (normal * half).sum(-1) ** 2 / squared
    n_cross_h_squared = torch.linalg.cross(*torch.broadcast_tensors(normal, half))
    n_cross_h_squared = (n_cross_h_squared**2).sum(-1) / squared
    n_dot_l = (normal * wi).sum(-1)
    value = ggx_d(n_dot_h_squared, n_cross_h_squared, alpha)
    value = value * smith_v((normal * wo).sum(-1), n_dot_l, alpha)
    value, v_dot_h, lit = _per_channel(f0, value, 0.5 * squared.sqrt(), n_dot_l > 0)
    return torch.where(lit, value * schlick_f(v_dot_h, f0), 0.0)


def specular_albedo(n_dot_v: Tensor, roughness: Tensor, f0: Tensor | float = F0) -> Tensor:
    """E, the share of light that the specular layer alone reflects, in [0, 1].

        E = integral over the half-sphere of D F V (n.wi) dwi

    [...] or, as F0, [..., 3]. Linear in F0 (Schlick). A polynomial fit, within 0.005 of quadrature
    for n.v in [0.02, 1], roughness in [0.05, 1] and any F0.
    """
    v, alpha = n_dot_v.clamp_min(COS_MIN), ggx_alpha(roughness)
    powers = torch.arange(5, device=v.device)
    v, roughness, u = torch.broadcast_tensors(v, roughness, v / (v + alpha))
    exponent = torch.tensor(_EXPONENTS, device=v.device).T
    monomials = v.new_ones(())
    for variable, e in zip((v, roughness, u), exponent, strict=True):
        # x ** 0 has gradient 0 everywhere, also at x = 0
        monomials = monomials * (variable[..., None] ** powers)[..., e]
    black, white = (
        (monomials * monomials.new_tensor(c)).sum(-1) for c in (_ALBEDO_BLACK, _ALBEDO_WHITE)
    )
    black, white = _per_channel(f0, black, white)
    return (black + f0 * (white - black)).clamp(0.0, 1.0)


def _per_channel(f0: Tensor | float, *numbers: Tensor) -> tuple[Tensor, ...]:
    """Numbers [...] as [..., 1] where F0 has channels."""
    return tuple(n[..., None] for n in numbers) if isinstance(f0, Tensor) else numbers


def evaluate(
    normal: Tensor,  # [..., 3]
    wo: Tensor,  # [..., 3]
    wi: Tensor,  # [..., 3]
    albedo: Tensor,  # [..., 3]
    roughness: Tensor,  # [...] in [0, 1]
    f0: Tensor | float = F0,  # a tensor is [..., 3]
) -> Tensor:
    """The whole BRDF, without the cosine: [..., 3]; 0 for n.wi <= 0.

    f = (1 - E(n.wo, roughness)) albedo / pi + D F V

    Args:
        normal, wo, wi: unit directions in one frame.
        albedo: linear, in [0, 1].
        roughness: perceptual; GGX alpha is its square.
        f0: reflectance at normal incidence, in [0, 1]; a tensor is [..., 3], per channel.
    """
    diffuse = (1 - specular_albedo((normal * wo).sum(-1), roughness, f0)) / math.pi
    layer = specular(normal, wo, wi, roughness, f0)
    if not isinstance(f0, Tensor):
        diffuse, layer = diffuse[..., None], layer[..., None]
    lit = (normal * wi).sum(-1, keepdim=True) > 0
    return torch.where(lit, diffuse * albedo + layer, 0.0)
