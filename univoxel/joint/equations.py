"""Gauss-Newton on the light of photographs: the normal equations that newton.py solves."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from univoxel import losses
from univoxel.color import CLIPPED
from univoxel.scene import Scene

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
    roughness: RoughnessTie | None = None

    def follow(self, step: Tensor) -> tuple[Tensor, Tensor]:
        """What a step of the light [3, D + B] does to log albedo [P, 3] and to roughness [P]."""
        moved = torch.einsum("cpd,cd->cp", self.cross, step)
        rough = torch.zeros_like(self.own[0])
        if (tie := self.roughness) is not None:
            rough = (tie.own - torch.einsum("cpd,cd->p", tie.cross, step)) / tie.norm
            moved = moved + tie.mixed * rough
        return ((self.own - moved) / self.norm).T, rough


@dataclass(frozen=True)
class RoughnessTie:
    """What ties light to the roughness of points, once their log albedo is eliminated."""

    cross: Tensor  # [3, P, D + B] light against roughness
    own: Tensor  # [P] gradient of roughness
    norm: Tensor  # [P] curvature of roughness
    mixed: Tensor  # [3, P] roughness against log albedo, not eliminated


@dataclass(frozen=True)
class Rougher:
    """How roughness may change."""

    rows: Rows  # as they are where roughness is larger
    by: float  # so much larger, > 0
    pull: float  # weight, > 0, of its squared distance from where it is likely
    away: Tensor  # [P] how far it is from there


@dataclass(frozen=True)
class Linear:
    """One channel of rows about a state: weighted, and encoded in sRGB."""

    residual: Tensor  # [P, V]
    by_light: Tensor  # [P, V, D] by the log map
    by_albedo: Tensor  # [P, V] by log albedo
    by_gain: Tensor  # [P, V] by a factor on everything, in log
    weight: Tensor  # [P, V] of a change of linear radiance, and its encoding
    drawn: Tensor  # [P, V] linear, as it is


def linearised(
    rows: Rows, light: Tensor, log_albedo: Tensor, c: int, differs: Differs | None
) -> Linear:
    """Residuals and slopes of channel c, with Cauchy weights."""
    albedo = log_albedo[:, c, None].exp()
    diffuse, drawn = drawn_by(rows, light, log_albedo, c, differs)
    by_diffuse, by_shine, gain = seen_of(rows, c, differs)
    target = rows.target[..., c]
    residual = target - losses.encode(drawn)
    weight = 1 / (1 + (residual / CAUCHY).square())
    weight = weight.masked_fill((target > CLIPPED) & (residual < 0), 0.0)
    root = weight.sqrt()
    slope = root * encoded_slope(drawn)
    jacobian = (albedo * rows.through)[..., None] * by_diffuse + by_shine
    jacobian = jacobian * (slope * gain)[..., None] * light[:, c]
    return Linear(root * residual, jacobian, slope * diffuse, slope * drawn, slope, drawn)


def seen_of(rows: Rows, c: int, differs: Differs | None) -> tuple[Tensor, Tensor, Tensor | float]:
    """What rows make of the map in channel c, of the base and besides, and their gain."""
    if differs is None:
        return rows.diffuse, rows.shine, 1.0
    gain = differs.gain[rows.view, c]
    if differs.change is None:
        return rows.diffuse, rows.shine, gain
    change = differs.change[rows.view, :, c]
    return rows.diffuse * change, rows.shine * change, gain


def drawn_by(
    rows: Rows, light: Tensor, log_albedo: Tensor, c: int, differs: Differs | None
) -> tuple[Tensor, Tensor]:
    """Linear radiance [P, V] of channel c: the part that the base multiplies, and all."""
    by_diffuse, by_shine, gain = seen_of(rows, c, differs)
    sky = rows.through * (by_diffuse @ light[:, c])
    diffuse = gain * log_albedo[:, c, None].exp() * (sky + rows.diffuse_blocked[..., c])
    return diffuse, diffuse + gain * (by_shine @ light[:, c] + rows.shine_blocked[..., c])


def normal_equations(
    rows: Rows,
    light: Tensor,
    log_albedo: Tensor,
    differs: Differs | None = None,
    rougher: Rougher | None = None,
) -> tuple[Tensor, Tensor, Tie]:
    """What some points say of the light, once their albedo is eliminated: the Hessian
    [3, D + B, D + B] and the gradient [3, D + B]; and what gives their albedo back.

    Changes of a view's map stay as they are.

    Args:
        light: [D, 3] the map.
        log_albedo: [P, 3].
        rougher: roughness is unknown too; `free_roughness` eliminates it.
    """
    hessian, gradient, cross, own, norm, cost = [], [], [], [], [], 0.0
    rough: list[tuple[Tensor, ...]] = []
    for c in range(3):
        part = linearised(rows, light, log_albedo, c, differs)
        r, jacobian, self_ = part.residual, part.by_light, part.by_albedo
        if differs is not None:
            of_view = torch.nn.functional.one_hot(rows.view, len(differs.gain))
            jacobian = torch.cat([jacobian, part.by_gain[..., None] * of_view], 2)
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
        if rougher is not None:
            _, more = drawn_by(rougher.rows, light, log_albedo, c, differs)
            slope = part.weight * (more - part.drawn) / rougher.by
            mixed = (slope * self_).sum(1)
            to_light = torch.einsum("pvd,pv->pd", jacobian, slope) - (mixed / n)[:, None] * tie
            gained = (slope * r).sum(1) - mixed * g / n
            curved = slope.square().sum(1) - mixed.square() / n
            rough.append((to_light, gained, curved, mixed))
    roughness = None
    if rougher is not None:
        to_light, gained, curved, mixed = (torch.stack(x) for x in zip(*rough, strict=True))
        gained = gained.sum(0) - rougher.pull * rougher.away
        roughness = RoughnessTie(to_light, gained, curved.sum(0) + rougher.pull, mixed)
    tie = Tie(torch.stack(cross), torch.stack(own), torch.stack(norm), cost, roughness)
    return torch.stack(hessian), torch.stack(gradient), tie


def free_roughness(tie: RoughnessTie) -> tuple[Tensor, Tensor]:
    """What eliminating the roughness of points takes from the Hessian, [3 (D + B), 3 (D + B)], for
    it ties the channels to one another, and from the gradient [3, D + B]."""
    cross = torch.cat(list(tie.cross), 1)
    taken = (tie.own / tie.norm) @ cross
    return gram(cross / tie.norm.sqrt()[:, None]), taken.view(3, -1)


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
        part = linearised(rows, light, log_albedo, c, differs)
        own = [part.by_light @ differs.basis.T, part.by_gain[..., None]]
        flat = torch.cat(own, 2).flatten(0, 1)
        hessian[c].index_add_(0, of_view, flat[:, :, None] * flat[:, None])
        gradient[c].index_add_(0, of_view, part.residual.flatten()[:, None] * flat)
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
