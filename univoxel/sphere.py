"""Directions: point sets on the sphere, frames around a normal, lat-long mapping, harmonics; and
names for the sides of an object."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
# Of an azimuth from the front, counter-clockwise seen from above: eighths of a turn. Left and right
# are those of whoever is in front.
SIDES = (
    *("front", "front right", "right", "back right"),
    *("back", "back left", "left", "front left"),
)
HIGH = 30.0  # degrees: without a photograph from so far above, tops are not seen


def fibonacci_hemisphere(count: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """[D, 3] unit directions around +Z, none on the horizon; each stands for 2 pi / D steradians.

    Raises:
        ValueError: count < 1.

    Source: Gonzalez 2010, "Measurement of areas on a sphere using Fibonacci and latitude-longitude
    lattices", offset by half a step.
    """
    return _spiral(count, lambda i: (i + 0.5) / count, dtype)


def fibonacci_sphere(count: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """[D, 3] unit directions over the sphere; each stands for 4 pi / D steradians.

    Raises:
        ValueError: count < 1.
    """
    return _spiral(count, lambda i: 1 - (2 * i + 1) / count, dtype)


def _spiral(count: int, height: Callable[[Tensor], Tensor], dtype: torch.dtype) -> Tensor:
    """Turn by the golden angle from one height to the next."""
    if count < 1:
        raise ValueError(f"fibonacci: count must be at least 1, got {count}")
    if torch.get_default_device().type == "meta":  # operations there import torch's compiler
        return torch.empty(count, 3, dtype=dtype)
    i = torch.arange(count, dtype=torch.float64)
    z, phi = height(i), i * _GOLDEN_ANGLE
    radius = (1 - z * z).sqrt()
    return torch.stack([radius * phi.cos(), radius * phi.sin(), z], -1).to(dtype)


def rotate_z(direction: Tensor, angle: Tensor) -> Tensor:
    """Turn directions [..., 3] by angles [...] about +Z: radians, counter-clockwise from above."""
    x, y, z = direction.unbind(-1)
    c, s = angle.cos(), angle.sin()
    return torch.stack(torch.broadcast_tensors(c * x - s * y, s * x + c * y, z), -1)


def frame(normal: Tensor) -> tuple[Tensor, Tensor]:
    """Tangent and bitangent [..., 3] that make a right-handed orthonormal frame with unit normals.

    Without branches and square roots; it jumps where the normal crosses z = 0, and is finite for
    any normal, zero too. Source: Duff et al. 2017, "Building an orthonormal basis, revisited".
    """
    x, y, z = normal.unbind(-1)
    sign = torch.copysign(torch.ones_like(z), z.detach())
    a = -1 / (sign + z)
    b = x * y * a
    tangent = torch.stack([1 + sign * x * x * a, sign * b, -sign * x], -1)
    bitangent = torch.stack([b, sign + y * y * a, -y], -1)
    return tangent, bitangent


def to_world(local: Tensor, normal: Tensor) -> Tensor:
    """Directions [..., 3] around +Z to directions around normals [..., 3], broadcast."""
    tangent, bitangent = frame(normal)
    return local[..., :1] * tangent + local[..., 1:2] * bitangent + local[..., 2:] * normal


def to_local(world: Tensor, normal: Tensor) -> Tensor:
    """The inverse of to_world for unit normals."""
    axes = (*frame(normal), normal)
    return torch.stack([(world * axis).sum(-1) for axis in axes], -1)


def random_rotation(generator: torch.Generator) -> Tensor:
    """A rotation [3, 3] evenly from all. Source: Shoemake 1992, "Uniform random rotations"."""
    w, x, y, z = torch.nn.functional.normalize(torch.randn(4, generator=generator), dim=0).tolist()
    return torch.tensor(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def direction_at(azimuth: float, elevation: float) -> tuple[float, float, float]:
    """A unit vector, from degrees counter-clockwise from +X and degrees above the horizon."""
    phi, up = math.radians(azimuth), math.radians(elevation)
    return math.cos(up) * math.cos(phi), math.cos(up) * math.sin(phi), math.sin(up)


def latlong_direction(uv: Tensor) -> Tensor:
    """Unit directions [..., 3] of places on an environment map.

    Args:
        uv: [..., 2], u to the right, v downwards, in [0, 1]; column c of W has its centre at
            u = (c + 0.5) / W, row r of H at v = (r + 0.5) / H.
    """
    u, v = uv.unbind(-1)
    phi, theta = math.pi * (1 - 2 * u), math.pi * (0.5 - v)
    return torch.stack([theta.cos() * phi.cos(), theta.cos() * phi.sin(), theta.sin()], -1)


def latlong_directions(height: int) -> Tensor:
    """Unit directions [height, 2 height, 3] of the texels of an environment map."""
    v, u = (torch.arange(height) + 0.5) / height, (torch.arange(2 * height) + 0.5) / (2 * height)
    return latlong_direction(torch.stack(torch.meshgrid(v, u, indexing="ij")[::-1], -1))


def direction_to_latlong(direction: Tensor) -> Tensor:
    """The inverse of latlong_direction: [..., 3] of any length above 0 -> uv [..., 2] in [0, 1].

    Differentiable; at the poles u is 0.5 and gets no gradient.
    """
    x, y, z = direction.unbind(-1)
    radius2 = x * x + y * y
    pole = radius2 < 1e-20
    x, y = torch.where(pole, 1.0, x), torch.where(pole, 0.0, y)
    radius = torch.where(pole, 0.0, torch.where(pole, 1.0, radius2).sqrt())
    u = 0.5 - torch.atan2(y, x) / (2 * math.pi)
    # Keep both arguments of atan2 from being 0 together: the zero vector then maps to v = 0.5.
    nothing = pole & (z == 0)
    v = 0.5 - torch.atan2(z, torch.where(nothing, 1.0, radius)) / math.pi
    return torch.stack([u, v], -1)


def texel_solid_angles(height: int, width: int) -> Tensor:
    """[H, W] steradians of the texels of a lat-long map, exact; they sum to 4 pi."""
    edge = torch.sin(math.pi * (0.5 - torch.arange(height + 1, dtype=torch.float64) / height))
    return (-(edge.diff()) * (2 * math.pi / width)).float()[:, None].expand(height, width)


def real_harmonics(order: int, direction: Tensor) -> Tensor:
    """Orthonormal real spherical harmonics Y_lm of degrees l up to `order`.

        Y_lm = N_lm Q_lm(z) Re (x + i y)^m,   m > 0;    Im (x + i y)^|m|, m < 0
        Q_l^m(z) = P_l^m(z) / (1 - z^2)^(m / 2), a polynomial; no Condon-Shortley phase

    Polynomials in x, y and z throughout: smooth at the poles too.

    Args:
        direction: [..., 3] unit.

    Returns:
        [..., (order + 1)^2], Y_lm at l^2 + l + m.
    """
    x, y, z = direction.unbind(-1)
    real, imaginary = torch.ones_like(x), torch.zeros_like(x)  # of (x + i y)^m
    diagonal = 1.0  # Q_mm = (2 m - 1)!!
    found: dict[tuple[int, int], Tensor] = {}
    for m in range(order + 1):
        before, now = torch.zeros_like(z), torch.full_like(z, diagonal)  # Q_{l-1}^m and Q_l^m
        for degree in range(m, order + 1):
            square = (2 * degree + 1) / (4 * math.pi)
            square *= math.factorial(degree - m) / math.factorial(degree + m)
            value = math.sqrt(square * (2 if m else 1)) * now
            found[degree, m], found[degree, -m] = value * real, value * (imaginary if m else real)
            above = (2 * degree + 1) * z * now - (degree + m) * before
            before, now = now, above / (degree + 1 - m)
        diagonal *= 2 * m + 1
        real, imaginary = x * real - y * imaginary, x * imaginary + y * real
    return torch.stack([found[k] for k in sorted(found)], -1)


def side_of(azimuth: float) -> str:
    """The name of a side, from its azimuth in degrees from the front, see SIDES."""
    return SIDES[math.floor(azimuth / 45 + 0.5) % 8]


def gaps(
    directions: np.ndarray, names: Sequence[str], gap: float, front: float = -90.0
) -> list[str]:
    """Where photographs are missing around the object, for people.

    Args:
        directions: [V, 3] from the object to each camera, +Z up.
        gap: degrees between neighbouring azimuths that are worth a word.
        front: azimuth of the front, degrees from +X.
    """
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    azimuth = (np.degrees(np.arctan2(unit[:, 1], unit[:, 0])) - front) % 360
    height = np.degrees(np.arcsin(unit[:, 2].clip(-1, 1)))
    told = []
    order = np.argsort(azimuth)
    steps = np.diff(azimuth[order], append=azimuth[order[0]] + 360)
    for k in np.argsort(-steps).tolist():
        if steps[k] < gap:
            break
        begin, end = int(order[k]), int(order[(k + 1) % len(order)])
        low = azimuth[begin]
        side = side_of(low + steps[k] / 2)
        told.append(
            f"no photograph from the {side}: there is a gap of {steps[k]:.0f} degrees between "
            f"{names[begin]} and {names[end]}"
        )
    if height.max() < HIGH:
        told.append(f"no photograph from more than {height.max():.0f} degrees above the horizon")
    return told
