"""Gauss-Newton on the light of photographs: the normal equations that newton.py solves."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from univoxel import losses
from univoxel.scene import Scene

CLIPPED = 0.97  # sRGB; brighter pixels are lower bounds
CAUCHY = 0.05  # sRGB; residuals beyond are taken for what the model cannot explain


@dataclass(frozen=True)
class Differs:
    """What differs between the photographs' lights, of which there are B."""

    gain: Tensor  # [B, 3]
    change: Tensor | None  # [B, D, 3] factor on the map
    basis: Tensor | None  # [R, D] that log change is a sum of


def view_differences(scene: Scene) -> Differs | None:
    """Those of the scene's photographs; None where they all have one light."""
    views = scene.views
    if views is None:
        return None
    change = views.sky_change()
    change = None if change is None else change.exp()
    return Differs(views.log_gain.exp(), change, views.sky_basis)


@dataclass(frozen=True)
class Rows:
    """What light does at V sightings of P points, linear in the map; constant in a round.

    A base colour, the albedo, multiplies part of it: of a dielectric the irradiance, [P, 1, D], as
    the sightings share it; of a metal the mirrored light, [P, V, D].
    """

    diffuse: Tensor  # sky into what the base multiplies: cosine, open share, solid angle, BRDF
    through: Tensor  # [P, V] that into radiance, for base 1
    shine: Tensor  # [P, V, D] sky into radiance that does not depend on the base
    diffuse_blocked: Tensor  # [P, V, 3] radiance from the blocked share, for base 1
    shine_blocked: Tensor  # [P, V, 3]
    target: Tensor  # [P, V, 3] sRGB-encoded
    view: Tensor  # [P, V] int64: which photograph


@dataclass(frozen=True)
class Tie:
    """What ties light to the albedo of some points, and their cost. The light is the log map of D
    directions and, where views differ, their B log gains after it."""

    cross: Tensor  # [3, P, D + B] light against log albedo
    own: Tensor  # [3, P] gradient of log albedo
    norm: Tensor  # [3, P] curvature of log albedo
    cost: float


def linearised(
    rows: Rows, light: Tensor, log_albedo: Tensor, c: int, differs: Differs | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """One channel's weighted residuals [P, V], and their slopes, weighted and encoded: by the log
    map [P, V, D], by log albedo [P, V], and by a factor on everything [P, V]."""
    albedo = log_albedo[:, c, None].exp()
    by_diffuse, by_shine, gain = rows.diffuse, rows.shine, 1.0
    if differs is not None:
        gain = differs.gain[rows.view, c]
        if differs.change is not None:
            change = differs.change[rows.view, :, c]
            by_diffuse, by_shine = by_diffuse * change, by_shine * change
    sky = rows.through * (by_diffuse @ light[:, c])
    diffuse = gain * albedo * (sky + rows.diffuse_blocked[..., c])
    drawn = diffuse + gain * (by_shine @ light[:, c] + rows.shine_blocked[..., c])
    target = rows.target[..., c]
    residual = target - losses.encode(drawn)
    weight = 1 / (1 + (residual / CAUCHY).square())
    weight = weight.masked_fill((target > CLIPPED) & (residual < 0), 0.0)
    root = weight.sqrt()
    slope = root * encoded_slope(drawn)
    jacobian = (albedo * rows.through)[..., None] * by_diffuse + by_shine
    jacobian = jacobian * (slope * gain)[..., None] * light[:, c]
    return root * residual, jacobian, slope * diffuse, slope * drawn


def normal_equations(
    rows: Rows, light: Tensor, log_albedo: Tensor, differs: Differs | None = None
) -> tuple[Tensor, Tensor, Tie]:
    """What some points say of the light, once their albedo is eliminated: the Hessian
    [3, D + B, D + B] and the gradient [3, D + B]; and what gives their albedo back.

    Changes of a view's map stay as they are.

    Args:
        light: [D, 3] the map.
        log_albedo: [P, 3].
    """
    hessian, gradient, cross, own, norm, cost = [], [], [], [], [], 0.0
    for c in range(3):
        r, jacobian, self_, whole = linearised(rows, light, log_albedo, c, differs)
        if differs is not None:
            of_view = torch.nn.functional.one_hot(rows.view, len(differs.gain))
            jacobian = torch.cat([jacobian, whole[..., None] * of_view], 2)
        n = self_.square().sum(1) + 1e-6  # a point that shows no diffuse light keeps its albedo
        tie = torch.einsum("pvd,pv->pd", jacobian, self_)
        g = (self_ * r).sum(1)
        flat, low = jacobian.flatten(0, 1), tie / n.sqrt()[:, None]
        hessian.append(gram(flat) - gram(low))
        gradient.append(r.flatten() @ flat - (g / n) @ tie)
        cross.append(tie)
        own.append(g)
        norm.append(n)
        cost += r.square().sum().item()
    tie = Tie(torch.stack(cross), torch.stack(own), torch.stack(norm), cost)
    return torch.stack(hessian), torch.stack(gradient), tie


def gram(rows: Tensor) -> Tensor:
    """rows.T @ rows: [N, M] -> [M, M]. Symmetric: five eighths of it are computed."""
    size = rows.shape[1]
    result = rows.new_empty(size, size)
    for first in range(0, size, step := -(-size // 4)):
        part, rest = slice(first, first + step), slice(first + step, None)
        result[part, first:] = rows[:, part].T @ rows[:, first:]
        result[rest, part] = result[part, rest].T
    return result


def view_equations(
    rows: Rows, light: Tensor, log_albedo: Tensor, differs: Differs
) -> tuple[Tensor, Tensor]:
    """Normal equations [3, B, R + 1, R + 1], [3, B, R + 1] of what each view has of its own: R
    weights of its map's change and its log gain. Map and albedo stay as they are."""
    assert differs.basis is not None
    views, count = len(differs.gain), len(differs.basis) + 1
    hessian = light.new_zeros(3, views, count, count)
    gradient = light.new_zeros(3, views, count)
    of_view = rows.view.flatten()
    for c in range(3):
        r, jacobian, _, whole = linearised(rows, light, log_albedo, c, differs)
        own = torch.cat([jacobian @ differs.basis.T, whole[..., None]], 2).flatten(0, 1)
        hessian[c].index_add_(0, of_view, own[:, :, None] * own[:, None])
        gradient[c].index_add_(0, of_view, r.flatten()[:, None] * own)
    return hessian, gradient


def solve_damped(system: Tensor, right: Tensor) -> Tensor | None:
    """Solve symmetric systems [..., N, N] x = [..., N], damped as much as they need it.

    Rounding, or data that say nothing of an unknown, can leave a system indefinite. Then lambda
    times the mean of its diagonal is added there (Levenberg 1944), lambda = 1e-6, 1e-4, 1e-2, 1,
    until there is a finite solution; None: there is none.
    """
    matrix, right = system.double(), right.double()[..., None]
    size = matrix.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None].clamp_min(1e-30)
    one = torch.eye(matrix.shape[-1], dtype=torch.double)
    for damping in (0.0, 1e-6, 1e-4, 1e-2, 1.0):
        factor, failed = torch.linalg.cholesky_ex(matrix + damping * size * one)
        if not failed.any():
            x = torch.cholesky_solve(right, factor)[..., 0].to(system.dtype)
            if x.isfinite().all():
                return x
    return None


def encoded_slope(linear: Tensor) -> Tensor:
    """Derivative of the sRGB curve."""
    power = 1.055 / 2.4 * linear.clamp_min(0.0031308) ** (1 / 2.4 - 1)
    return torch.where(linear <= 0.0031308, 12.92, power)


def graph_laplacian(direction: Tensor, neighbours: int = 6) -> Tensor:
    """Laplacian [D, D] of the graph of nearest neighbours on the sphere, symmetric."""
    near = (direction @ direction.T).topk(neighbours + 1, 1).indices[:, 1:]
    adjacent = torch.zeros(len(direction), len(direction)).scatter_(1, near, 1.0)
    adjacent = torch.maximum(adjacent, adjacent.T)
    return torch.diag(adjacent.sum(1)) - adjacent
