"""One environment map, albedo and roughness from the photographs, with traced visibility.

Local lobes explain every photograph and leave shadows in the albedo. Once geometry stands, the
light is known to be one distant map that reaches a point where nothing is in the way, and what is
in the way shines as bright as the photographs show it. That leaves few unknowns: rounds of Adam on
map and materials alternate with Gauss-Newton steps on the map.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from univoxel import brdf, losses
from univoxel.config import JointConfig
from univoxel.data import Photos
from univoxel.ops import VisibilityScene, shade_map
from univoxel.optim import RowAdam
from univoxel.render.pipeline import extract_mesh
from univoxel.render.transport import (
    Observations,
    Transport,
    mean_colors,
    observe,
    surface_points,
    trace,
)
from univoxel.scene import Scene

CLIPPED = 0.97  # sRGB; brighter pixels are lower bounds
CAUCHY = 0.05  # sRGB; residuals beyond are taken for what the model cannot explain


@dataclass(frozen=True)
class Problem:
    """Everything about the photographs and the geometry that stays fixed."""

    seen: Observations
    transport: Transport
    target: Tensor  # [S, 3] sRGB-encoded sightings
    voxel_size: float

    @property
    def solid_angle(self) -> float:
        return 4 * math.pi / len(self.transport.direction)


@torch.no_grad()
def pose(scene: Scene, photos: Photos, cfg: JointConfig, seed: int) -> Problem:
    """Sample the surface, gather its sightings and trace what light can reach it."""
    generator = torch.Generator().manual_seed(seed)
    mesh = extract_mesh(scene)
    tracer = VisibilityScene(mesh.vertices, mesh.faces)
    offset = scene.field.voxel_size
    bright = mean_colors(observe(mesh.vertices, mesh.normals, photos, tracer, offset))
    position, normal = surface_points(mesh, cfg.points, generator)
    seen = observe(position, normal, photos, tracer, offset)
    direction = scene.sky.direction
    transport = trace(seen, tracer, mesh, bright, direction, cfg.rays, offset, generator)
    return Problem(seen, transport, losses.encode(seen.color), offset)


def draw(problem: Problem, points: int, views: int) -> tuple[Tensor, Tensor]:
    """Random points that are seen, and random sightings of each: indices [points * views]."""
    counts = problem.seen.offsets.diff()
    usable = (counts > 0).nonzero()[:, 0]
    point = usable[torch.randint(len(usable), (points,))]
    which = (torch.rand(points, views) * counts[point][:, None]).long()
    sighting = problem.seen.offsets[point][:, None] + which
    return point.repeat_interleave(views), sighting.reshape(-1)


def adam_round(
    scene: Scene, problem: Problem, cfg: JointConfig, steps: int, rates: tuple[float, float, float]
) -> Iterator[float]:
    """Adam on features, material head and map (in that order of rates); yields the loss."""
    seen, transport = problem.seen, problem.transport
    optimizer = RowAdam(
        [
            {"params": [scene.field.features], "eps": 1e-8, "lr": rates[0]},
            {"params": list(scene.material.parameters()), "lr": rates[1]},
            {"params": [scene.sky.log_radiance], "lr": rates[2]},
        ],
        betas=(0.9, 0.99),
    )
    initial = [group["lr"] for group in optimizer.param_groups]
    for step in range(steps):
        for group, rate in zip(optimizer.param_groups, initial, strict=True):
            group["lr"] = rate * 0.1 ** (step / steps)
        index, sighting = draw(problem, cfg.batch_points, cfg.batch_views)
        points = index[:: cfg.batch_views]
        features = scene.field.sample(seen.position[points]).features
        albedo, roughness = scene.material(features)
        repeat = torch.arange(len(points)).repeat_interleave(cfg.batch_views)
        rgb = shade_map(
            scene.sky.radiance,
            transport.open,
            transport.indirect,
            index,
            seen.normal[index],
            seen.wo[sighting],
            albedo[repeat],
            roughness[repeat],
            transport.direction,
            problem.solid_angle,
        )
        beside = seen.position[points]
        beside = beside + 2 * problem.voxel_size * torch.randn_like(beside)
        albedo_near, roughness_near = scene.material(scene.field.sample(beside).features)
        loss = (
            losses.photometric(losses.encode(rgb), problem.target[sighting], clipped=CLIPPED)
            + cfg.albedo_smoothness * losses.smoothness(albedo, albedo_near)
            + cfg.roughness_smoothness * losses.smoothness(roughness, roughness_near)
        )
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        yield loss.item()


@torch.no_grad()
def newton_round(scene: Scene, problem: Problem, cfg: JointConfig, steps: int) -> Iterator[float]:
    """Gauss-Newton steps on the log map, with the albedo of every point eliminated.

    The normal equations for log map x and log albedo of the points are block diagonal in the
    albedo; its Schur complement is D x D. What then speaks for the map is only what no albedo can
    explain: how a point's brightness changes from view to view, and with it the absolute scale,
    from highlights of known reflectance. Residuals are in sRGB-encoded colour with Cauchy weights;
    a graph Laplacian keeps the log map smooth. Yields the mean weighted squared residual.
    """
    seen, sky = problem.seen, scene.sky
    counts = seen.offsets.diff()
    rich = (counts >= cfg.newton_views // 2).nonzero()[:, 0]
    chosen = rich[torch.randperm(len(rich))[: cfg.newton_points]]
    albedo, roughness = scene.material(scene.field.sample(seen.position[chosen]).features)
    log_albedo = albedo.clamp_min(1e-3).log()
    which = (torch.rand(len(chosen), cfg.newton_views) * counts[chosen][:, None]).long()
    sighting = seen.offsets[chosen][:, None] + which
    smooth = graph_laplacian(sky.direction)
    for _ in range(steps):
        blocks = [
            normal_equations(
                problem, sky.radiance, chosen[k], sighting[k], log_albedo[k], roughness[k]
            )
            for k in torch.arange(len(chosen)).split(cfg.newton_chunk)
        ]
        rows = sighting.numel()
        hessian = sum(b.hessian for b in blocks) / rows
        gradient = sum(b.gradient for b in blocks) / rows
        x = sky.log_radiance.T  # [3, D]
        system = hessian + cfg.newton_smooth * smooth
        system.diagonal(dim1=1, dim2=2).add_(cfg.newton_damping)
        right = gradient - cfg.newton_smooth * x @ smooth
        step = torch.linalg.solve(system, right[..., None])[..., 0].clamp(-1, 1)
        sky.log_radiance += step.T
        change = [(b.own - torch.einsum("cpd,cd->pc", b.cross, step)) / b.norm for b in blocks]
        log_albedo = (log_albedo + torch.cat(change).clamp(-0.5, 0.5)).clamp(-7.0, 0.0)
        yield sum(b.cost for b in blocks) / rows


@dataclass(frozen=True)
class Block:
    """Normal equations of some points: the map's part, and what ties it to their albedo."""

    hessian: Tensor  # [3, D, D]
    gradient: Tensor  # [3, D]
    cross: Tensor  # [3, P, D] map against log albedo
    own: Tensor  # [P, 3] gradient of log albedo
    norm: Tensor  # [P, 3] curvature of log albedo
    cost: float


def normal_equations(
    problem: Problem,
    light: Tensor,  # [D, 3]
    point: Tensor,  # [P]
    sighting: Tensor,  # [P, V]
    log_albedo: Tensor,  # [P, 3]
    roughness: Tensor,  # [P]
) -> Block:
    transport, seen = problem.transport, problem.seen
    normal, wo = seen.normal[point][:, None], seen.wo[sighting]
    cosine = (normal @ transport.direction.T).clamp_min(0) * problem.solid_angle  # [P, 1, D]
    through = 1 - brdf.specular_albedo((normal * wo).sum(2), roughness[:, None])  # [P, V]
    shine = cosine * brdf.specular(
        normal[:, :, None], wo[:, :, None], transport.direction, roughness[:, None, None]
    )  # [P, V, D]
    open_share = transport.open[point].float()[:, None] / 255
    blocked = transport.indirect[point].float()  # [P, D, 3]
    base = (through / math.pi)[..., None] * cosine  # [P, V, D] for albedo 1
    hessian, gradient, cross, own, norm, cost = [], [], [], [], [], 0.0
    for c in range(3):
        albedo = log_albedo[:, c].exp()[:, None]
        arrives = open_share * light[:, c] + blocked[:, None, :, c]  # [P, 1, D]
        diffuse = albedo * (base * arrives).sum(2)
        drawn = diffuse + (shine * arrives).sum(2)
        target = problem.target[sighting][..., c]
        slope = encoded_slope(drawn)
        residual = target - losses.encode(drawn)
        weight = 1 / (1 + (residual / CAUCHY).square())
        weight = weight.masked_fill((target > CLIPPED) & (residual < 0), 0.0)
        root = weight.sqrt()
        jacobian = (albedo[..., None] * base + shine) * (open_share * light[:, c])
        jacobian = jacobian * (root * slope)[..., None]
        self_ = root * slope * diffuse
        r = root * residual
        n = self_.square().sum(1) + 1e-6
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
        *(torch.stack(t) for t in (hessian, gradient, cross)),
        torch.stack(own, 1),
        torch.stack(norm, 1),
        cost,
    )


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
