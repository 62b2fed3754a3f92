"""Normal equations of Gauss-Newton on the environment map, which newton.py solves."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from univoxel.color import CLIPPED, linear_to_srgb_unclipped, srgb_slope
from univoxel.scene import Scene


@dataclass(frozen=True)
class ViewDifferences:
    """What differs between the photographs' lights, of which there are B."""

    gain: Tensor  # [B, 3]
    map_factor: Tensor | None  # [B, D, 3] on the map
    basis: Tensor | None  # [R, D] that the logarithm of the factor is a sum of


def view_differences(scene: Scene) -> ViewDifferences | None:
    """Those of the scene's photographs; None if they all have one light."""
    views = scene.views
    if views is None:
        return None
    log_factor = views.sky_change()
    factor = None if log_factor is None else log_factor.exp()
    return ViewDifferences(views.log_gain.exp(), factor, views.sky_basis)


@dataclass(frozen=True)
class LinearTransport:
    """Radiance of V observations of P points, linear in the map of D nodes; constant in a round.

        radiance_pv = base_p (diffuse_factor_pv diffuse_pv . map + diffuse_indirect_pv)
                      + specular_pv . map + specular_indirect_pv

    The base colour is the albedo: of a dielectric it multiplies the irradiance, [P, 1, D], which
    the observations share; of a metal the reflected light, [P, V, D].
    """

    diffuse: Tensor  # map into what the base multiplies: cosine, visibility, solid angle, BRDF
    diffuse_factor: Tensor  # [P, V] that into radiance, for base 1
    specular: Tensor  # [P, V, D] map into radiance that does not depend on the base
    diffuse_indirect: Tensor  # [P, V, 3] radiance from occluded directions, for base 1
    specular_indirect: Tensor  # [P, V, 3]
    target: Tensor  # [P, V, 3] sRGB-encoded
    view: Tensor  # [P, V] int64: which photograph
    # [2, P, V, 3] radiance from a flash, for base 1 and what does not depend on the base
    flash: Tensor | None = None


@dataclass(frozen=True)
class EliminatedAlbedo:
    """What gives the albedo of P points back from a step of the light, and their cost.

    The light is the log map of D nodes and, after it, the B log gains of views that differ, and the
    log radiance of a flash.
    """

    cross: Tensor  # [3, P, D + B] second derivatives by light and log albedo
    gradient: Tensor  # [3, P] by log albedo
    curvature: Tensor  # [3, P] by log albedo
    cost: float  # weighted squared residuals
    roughness: EliminatedRoughness | None = None

    def back_substituted(self, step: Tensor) -> tuple[Tensor, Tensor]:
        """Steps of log albedo [P, 3] and of roughness [P] that belong to one of the light
        [3, D + B]."""
        from_light = torch.einsum("cpd,cd->cp", self.cross, step)
        to_roughness = torch.zeros_like(self.gradient[0])
        if (rough := self.roughness) is not None:
            to_roughness = rough.gradient - torch.einsum("cpd,cd->p", rough.cross, step)
            to_roughness = to_roughness / rough.curvature
            from_light = from_light + rough.cross_albedo * to_roughness
        return ((self.gradient - from_light) / self.curvature).T, to_roughness


@dataclass(frozen=True)
class EliminatedRoughness:
    """What gives the roughness of P points back, once their log albedo is eliminated."""

    cross: Tensor  # [3, P, D + B] second derivatives by light and roughness
    gradient: Tensor  # [P] by roughness
    curvature: Tensor  # [P] by roughness
    cross_albedo: Tensor  # [3, P] by roughness and log albedo, which is not eliminated here


@dataclass(frozen=True)
class RoughnessStep:
    """A finite difference of roughness, and its prior."""

    transport: LinearTransport  # as it is where roughness is larger
    size: float  # how much larger, > 0
    prior_weight: float  # > 0, of the squared deviation
    deviation: Tensor  # [P] of roughness from where it is likely


@dataclass(frozen=True)
class Linearisation:
    """One channel of the observations about a state: weighted, and encoded in sRGB."""

    residual: Tensor  # [P, V]
    by_map: Tensor  # [P, V, D] slope by the log map
    by_albedo: Tensor  # [P, V] slope by log albedo
    by_gain: Tensor  # [P, V] slope by the log of a factor on everything
    by_flash: Tensor | None  # [P, V] slope by the log of the flash; None: there is none
    by_radiance: Tensor  # [P, V] slope by linear radiance: root of the weight, and the encoding
    radiance: Tensor  # [P, V] linear


def linearise(
    transport: LinearTransport,
    sky: Tensor,
    log_albedo: Tensor,
    cauchy: float,
    c: int,
    differences: ViewDifferences | None,
) -> Linearisation:
    """Residuals and slopes of channel c, with Cauchy weights."""
    albedo = log_albedo[:, c, None].exp()
    diffuse_radiance, radiance = channel_radiance(transport, sky, log_albedo, c, differences)
    diffuse, specular, gain = transport_in_views(transport, c, differences)
    target = transport.target[..., c]
    residual = target - linear_to_srgb_unclipped(radiance)
    weight = 1 / (1 + (residual / cauchy).square())
    weight = weight.masked_fill((target > CLIPPED) & (residual < 0), 0.0)
    root = weight.sqrt()
    slope = root * srgb_slope(radiance)
    by_map = (albedo * transport.diffuse_factor)[..., None] * diffuse + specular
    by_map = by_map * (slope * gain)[..., None] * sky[:, c]
    by_albedo, by_gain, by_flash = slope * diffuse_radiance, slope * radiance, None
    if transport.flash is not None:
        of_base, beside = transport.flash[..., c]
        by_flash = slope * gain * (albedo * of_base + beside)
    return Linearisation(root * residual, by_map, by_albedo, by_gain, by_flash, slope, radiance)


def transport_in_views(
    transport: LinearTransport, c: int, differences: ViewDifferences | None
) -> tuple[Tensor, Tensor, Tensor | float]:
    """Transport of channel c with what the views' maps differ by, diffuse and specular, and the
    views' gain."""
    if differences is None:
        return transport.diffuse, transport.specular, 1.0
    gain = differences.gain[transport.view, c]
    if differences.map_factor is None:
        return transport.diffuse, transport.specular, gain
    factor = differences.map_factor[transport.view, :, c]
    return transport.diffuse * factor, transport.specular * factor, gain


def channel_radiance(
    transport: LinearTransport,
    sky: Tensor,
    log_albedo: Tensor,
    c: int,
    differences: ViewDifferences | None,
) -> tuple[Tensor, Tensor]:
    """Linear radiance [P, V] of channel c: the part that the base multiplies, and the whole."""
    diffuse, specular, gain = transport_in_views(transport, c, differences)
    from_sky = transport.diffuse_factor * (diffuse @ sky[:, c])
    other = transport.diffuse_indirect[..., c]
    mirrored = specular @ sky[:, c] + transport.specular_indirect[..., c]
    if transport.flash is not None:
        other, mirrored = other + transport.flash[0, ..., c], mirrored + transport.flash[1, ..., c]
    diffuse_radiance = gain * log_albedo[:, c, None].exp() * (from_sky + other)
    return diffuse_radiance, diffuse_radiance + gain * mirrored


def normal_equations(
    transport: LinearTransport,
    sky: Tensor,
    log_albedo: Tensor,
    cauchy: float,
    differences: ViewDifferences | None = None,
    roughness_step: RoughnessStep | None = None,
) -> tuple[Tensor, Tensor, EliminatedAlbedo]:
    """Hessian [3, D + B, D + B] and gradient [3, D + B] by the light, the albedo of the points
    eliminated; and what gives their albedo back.

    Changes of a view's map stay as they are.

    Args:
        sky: [D, 3] radiance of the map.
        log_albedo: [P, 3].
        cauchy: sRGB, scale of the Cauchy weights.
        roughness_step: roughness is unknown too; `roughness_terms` eliminates it.
    """
    hessians, gradients, crosses, by_albedo, curvatures, cost = [], [], [], [], [], 0.0
    by_roughness: list[tuple[Tensor, ...]] = []
    for c in range(3):
        part = linearise(transport, sky, log_albedo, cauchy, c, differences)
        residual, slope, jacobian = part.residual, part.by_albedo, part.by_map
        if differences is not None:
            of_view = torch.nn.functional.one_hot(transport.view, len(differences.gain))
            jacobian = torch.cat([jacobian, part.by_gain[..., None] * of_view], 2)
        if part.by_flash is not None:
            jacobian = torch.cat([jacobian, part.by_flash[..., None]], 2)
        # A point that shows no diffuse light keeps its albedo
        curvature = slope.square().sum(1) + 1e-6
        cross = torch.einsum("pvd,pv->pd", jacobian, slope)
        gradient = (slope * residual).sum(1)
        flat, root = jacobian.flatten(0, 1), cross / curvature.sqrt()[:, None]
        hessians.append(gram(flat) - gram(root))
        gradients.append(residual.flatten() @ flat - (gradient / curvature) @ cross)
        crosses.append(cross)
        by_albedo.append(gradient)
        curvatures.append(curvature)
        cost += residual.square().sum().item()
        if roughness_step is not None:
            rougher = roughness_step.transport
            _, radiance = channel_radiance(rougher, sky, log_albedo, c, differences)
            change = part.by_radiance * (radiance - part.radiance) / roughness_step.size
            mixed = (change * slope).sum(1)
            cross_light = torch.einsum("pvd,pv->pd", jacobian, change)
            cross_light = cross_light - (mixed / curvature)[:, None] * cross
            descent = (change * residual).sum(1) - mixed * gradient / curvature
            bend = change.square().sum(1) - mixed.square() / curvature
            by_roughness.append((cross_light, descent, bend, mixed))
    eliminated = EliminatedAlbedo(
        torch.stack(crosses),
        torch.stack(by_albedo),
        torch.stack(curvatures),
        cost,
        None if roughness_step is None else _roughness(by_roughness, roughness_step),
    )
    return torch.stack(hessians), torch.stack(gradients), eliminated


def _roughness(channels: list[tuple[Tensor, ...]], step: RoughnessStep) -> EliminatedRoughness:
    """Derivatives by roughness, from those of each channel, with the prior."""
    cross, gradient, curvature, mixed = (torch.stack(x) for x in zip(*channels, strict=True))
    gradient = gradient.sum(0) - step.prior_weight * step.deviation
    return EliminatedRoughness(cross, gradient, curvature.sum(0) + step.prior_weight, mixed)


def roughness_terms(roughness: EliminatedRoughness) -> tuple[Tensor, Tensor]:
    """What the elimination of roughness subtracts from the Hessian, [3 (D + B), 3 (D + B)], for it
    couples the channels, and from the gradient [3, D + B]."""
    cross = torch.cat(list(roughness.cross), 1)
    from_gradient = (roughness.gradient / roughness.curvature) @ cross
    return gram(cross / roughness.curvature.sqrt()[:, None]), from_gradient.view(3, -1)


def gram(matrix: Tensor) -> Tensor:
    """matrix.T @ matrix: [N, M] -> [M, M]. Symmetric: five eighths of it are computed."""
    size = matrix.shape[1]
    result = matrix.new_empty(size, size)
    for begin in range(0, size, step := -(-size // 4)):
        block, rest = slice(begin, begin + step), slice(begin + step, None)
        result[block, begin:] = matrix[:, block].T @ matrix[:, begin:]
        result[rest, block] = result[block, rest].T
    return result


def view_equations(
    transport: LinearTransport,
    sky: Tensor,
    log_albedo: Tensor,
    cauchy: float,
    differences: ViewDifferences,
) -> tuple[Tensor, Tensor]:
    """Hessian [3, B, R + 1, R + 1] and gradient [3, B, R + 1] of what each view has of its own: R
    weights of its map's change and its log gain. Map and albedo stay as they are."""
    assert differences.basis is not None
    views, count = len(differences.gain), len(differences.basis) + 1
    hessian = sky.new_zeros(3, views, count, count)
    gradient = sky.new_zeros(3, views, count)
    of_view = transport.view.flatten()
    for c in range(3):
        part = linearise(transport, sky, log_albedo, cauchy, c, differences)
        slopes = [part.by_map @ differences.basis.T, part.by_gain[..., None]]
        flat = torch.cat(slopes, 2).flatten(0, 1)
        hessian[c].index_add_(0, of_view, flat[:, :, None] * flat[:, None])
        gradient[c].index_add_(0, of_view, part.residual.flatten()[:, None] * flat)
    return hessian, gradient


def solve_damped(system: Tensor, right_side: Tensor) -> Tensor | None:
    """Solve symmetric systems [..., N, N] x = [..., N], damped as much as they need it.

    Rounding, or an unknown that the data do not depend on, can leave a system indefinite. Then
    lambda times the mean of its diagonal is added there (Levenberg 1944), lambda = 1e-6, 1e-4,
    1e-2, 1, until there is a finite solution; None: there is none.
    """
    matrix, right_side = system.double(), right_side.double()[..., None]
    size = matrix.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None].clamp_min(1e-30)
    identity = torch.eye(matrix.shape[-1], dtype=torch.double)
    for damping in (0.0, 1e-6, 1e-4, 1e-2, 1.0):
        factor, failed = torch.linalg.cholesky_ex(matrix + damping * size * identity)
        if not failed.any():
            x = torch.cholesky_solve(right_side, factor)[..., 0].to(system.dtype)
            if x.isfinite().all():
                return x
    return None


def graph_laplacian(direction: Tensor, neighbours: int) -> Tensor:
    """Laplacian [D, D] of the graph of nearest neighbours on the sphere, symmetric."""
    nearest = (direction @ direction.T).topk(neighbours + 1, 1).indices[:, 1:]
    adjacent = torch.zeros(len(direction), len(direction)).scatter_(1, nearest, 1.0)
    adjacent = torch.maximum(adjacent, adjacent.T)
    return torch.diag(adjacent.sum(1)) - adjacent
