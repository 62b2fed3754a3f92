"""Gauss-Newton on the light of photographs: the normal equations that joint.py solves."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from univoxel import losses
from univoxel.lights.views import ViewLights
from univoxel.scene import Scene

CLIPPED = 0.97  # sRGB; brighter pixels are lower bounds
CAUCHY = 0.05  # sRGB; residuals beyond are taken for what the model cannot explain
WEIGHTS_PRIOR = 10.0  # on the changes of a view's map, in units of the Laplacian's weight


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
    """What light does at V sightings of P points, linear in the map; constant in a round."""

    diffuse: Tensor  # [P, D] sky into irradiance: cosine, open share and solid angle
    through: Tensor  # [P, V] irradiance into radiance, for albedo 1
    shine: Tensor  # [P, V, D] sky into specular radiance
    diffuse_blocked: Tensor  # [P, V, 3] radiance from the blocked share, for albedo 1
    shine_blocked: Tensor  # [P, V, 3]
    target: Tensor  # [P, V, 3] sRGB-encoded
    view: Tensor  # [P, V] int64: which photograph


@dataclass(frozen=True)
class Block:
    """Normal equations of some points: the light's part, and what ties it to their albedo.

    The light is the log map of D directions and, where views differ, their B log gains after it.
    """

    hessian: Tensor  # [3, D + B, D + B]
    gradient: Tensor  # [3, D + B]
    cross: Tensor  # [3, P, D + B] light against log albedo
    own: Tensor  # [3, P] gradient of log albedo
    norm: Tensor  # [3, P] curvature of log albedo
    weights: tuple[Tensor, Tensor] | None  # [3, B, R, R], [3, B, R] of each view's change alone
    cost: float


def normal_equations(
    rows: Rows, light: Tensor, log_albedo: Tensor, differs: Differs | None = None
) -> Block:
    """The block of some points for map `light` [D, 3] and `log_albedo` [P, 3].

    What differs from view to view stays as it is.
    """
    hessian, gradient, cross, own, norm, weights, cost = [], [], [], [], [], [], 0.0
    for c in range(3):
        albedo = log_albedo[:, c, None].exp()
        by_diffuse, by_shine, gain = rows.diffuse[:, None], rows.shine, 1.0
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
        r = root * residual
        jacobian = (albedo * rows.through)[..., None] * by_diffuse + by_shine
        jacobian = jacobian * (slope * gain)[..., None] * light[:, c]
        if differs is not None:
            if differs.basis is not None:
                weights.append(by_view(jacobian @ differs.basis.T, r, rows.view, len(differs.gain)))
            of_view = torch.nn.functional.one_hot(rows.view, len(differs.gain))
            jacobian = torch.cat([jacobian, (slope * drawn)[..., None] * of_view], 2)
        self_ = slope * diffuse
        n = self_.square().sum(1) + 1e-6  # a point that shows no diffuse light keeps its albedo
        tie = torch.einsum("pvd,pv->pd", jacobian, self_)
        g = (self_ * r).sum(1)
        flat, low = jacobian.flatten(0, 1), tie / n.sqrt()[:, None]
        hessian.append(flat.T @ flat - low.T @ low)
        gradient.append(r.flatten() @ flat - (g / n) @ tie)
        cross.append(tie)
        own.append(g)
        norm.append(n)
        cost += r.square().sum().item()
    return Block(
        torch.stack(hessian),
        torch.stack(gradient),
        torch.stack(cross),
        torch.stack(own),
        torch.stack(norm),
        (torch.stack([w[0] for w in weights]), torch.stack([w[1] for w in weights]))
        if weights
        else None,
        cost,
    )


def by_view(jacobian: Tensor, residual: Tensor, view: Tensor, views: int) -> tuple[Tensor, Tensor]:
    """Normal equations [B, R, R], [B, R] of each view's own R unknowns.

    Args:
        jacobian, residual, view: [P, V, R], [P, V] and [P, V] of sightings.
    """
    j, r, view = jacobian.flatten(0, 1), residual.flatten(), view.flatten()
    hessian = j.new_zeros(views, j.shape[1], j.shape[1])
    gradient = j.new_zeros(views, j.shape[1])
    hessian.index_add_(0, view, j[:, :, None] * j[:, None])
    return hessian, gradient.index_add_(0, view, r[:, None] * j)


def weights_step(views: ViewLights, blocks: list[Block], sightings: int, smooth: float) -> None:
    """A Gauss-Newton step of each view's change of the map, all else as it is."""
    parts = [b.weights for b in blocks if b.weights is not None]
    if not parts or views.sky_weights is None:
        return
    hessian, gradient = (torch.stack(p).sum(0) / sightings for p in zip(*parts, strict=True))
    now = views.sky_weights - views.sky_weights.mean(0)  # [B, R, 3]
    hessian.diagonal(dim1=2, dim2=3).add_(WEIGHTS_PRIOR * smooth)
    right = gradient - WEIGHTS_PRIOR * smooth * now.permute(2, 0, 1)
    step = torch.linalg.solve(hessian, right[..., None])[..., 0].clamp(-1, 1)
    views.sky_weights.add_(step.permute(1, 2, 0))


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
