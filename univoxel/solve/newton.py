"""Gauss-Newton steps on the environment map, the albedo eliminated."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import torch
from torch import Tensor

from univoxel import brdf
from univoxel.config import JointConfig
from univoxel.ops import specular_response
from univoxel.scene import Scene
from univoxel.solve.equations import (
    Rows,
    graph_laplacian,
    normal_equations,
    solve_damped,
    view_differences,
    view_equations,
)
from univoxel.solve.sightings import LEAST_VIEWS, Problem, sightings_of, widened

NEWTON_CHUNK = 256  # points whose equations are built at once
WEIGHTS_PRIOR = 10.0  # on changes of a view's map, in units of the Laplacian's weight
UNSOLVABLE = "the equations for the map have no solution: it stays as it is in this round"
LEAST_CHUNKS = 2  # on a machine however slow


@torch.no_grad()
def newton_round(
    scene: Scene,
    problem: Problem,
    cfg: JointConfig,
    seconds: float = math.inf,
    tell: Callable[[str], None] = print,
) -> list[float]:
    """Gauss-Newton steps on the log map, with the albedo of every point eliminated.

    The normal equations for log map and log albedo of the points are block diagonal in the albedo;
    its Schur complement is D x D. What then speaks for the map is only what no albedo can explain:
    how a point's brightness changes from view to view, and with it the absolute scale, from
    highlights of known reflectance. Residuals are in sRGB-encoded colour with Cauchy weights; a
    graph Laplacian keeps the log map smooth. Where light varies, the views' log gains are solved
    for together with the map, and before that, with the map as it is, what each view's map has of
    its own. Returns the mean weighted squared residual before each step.

    Args:
        seconds: wall time that it may take, about: fewer points serve where all would take more.
        tell: called with a sentence where the equations have no solution; then the round is over.
    """
    begin = time.monotonic()
    seen, sky = problem.seen, scene.sky
    assert sky is not None
    counts = seen.offsets.diff()
    # Points that are seen as often as usual: of few photographs that is less than is wanted
    usual = float(counts[counts > 0].float().median())
    least = max(LEAST_VIEWS, min(cfg.newton_views // 2, usual))
    rich = (counts >= least).nonzero()[:, 0]
    chosen = rich[torch.randperm(len(rich))[: cfg.newton_points]]
    if not len(chosen):
        return []
    chosen, parts = in_parts(chosen, problem.metal)
    albedo, roughness, _ = scene.material(scene.field.features_at(seen.position[chosen]))
    log_albedo = albedo.clamp_min(1e-3).log()
    sighting = sightings_of(problem, chosen, cfg.newton_views)
    roughness = widened(roughness, len(sky.direction))
    rows, spent = [], 0.0  # on the equations of one part
    for k in parts:
        rows.append(light_rows(problem, chosen[k], sighting[k], roughness[k]))
        if len(rows) == 1 and seconds < math.inf:
            before = time.monotonic()
            normal_equations(rows[0], sky.radiance, log_albedo[k])
            spent = time.monotonic() - before
        so_far = time.monotonic() - begin
        if len(rows) >= LEAST_CHUNKS and so_far + cfg.newton_steps * len(rows) * spent > seconds:
            break
    parts = parts[: len(rows)]
    count = sum(map(len, parts))
    sighting, log_albedo = sighting[:count], log_albedo[:count]
    smooth = cfg.newton_smooth * graph_laplacian(sky.direction)
    unknowns = len(smooth) + (len(scene.views) if scene.views else 0)
    smooth = torch.nn.functional.pad(smooth, 2 * (0, unknowns - len(smooth)))
    costs = []
    for _ in range(cfg.newton_steps):
        differs = view_differences(scene)
        if differs is not None and differs.basis is not None:
            hessian = slope = torch.zeros(())
            for r, k in zip(rows, parts, strict=True):
                h, g = view_equations(r, sky.radiance, log_albedo[k], differs)
                hessian, slope = hessian + h / sighting.numel(), slope + g / sighting.numel()
            if not views_step(scene, hessian, slope, cfg.newton_smooth):
                tell(UNSOLVABLE)
                break
            differs = view_differences(scene)
        x = sky.log_radiance.T  # [3, D]
        x = torch.nn.functional.pad(x, (0, unknowns - x.shape[1]))  # no gain is likelier than 1
        system, right, ties = smooth, -x @ smooth, []
        for r, k in zip(rows, parts, strict=True):  # added up at once: all would take much memory
            h, g, tie = normal_equations(r, sky.radiance, log_albedo[k], differs)
            system, right = system + h / sighting.numel(), right + g / sighting.numel()
            ties.append(tie)
        system.diagonal(dim1=1, dim2=2).add_(cfg.newton_smooth)
        step = solve_damped(system, right)
        if step is None:
            tell(UNSOLVABLE)
            break
        step = step.clamp(-1, 1)
        to_map, to_gain = step.split([len(sky.direction), unknowns - len(sky.direction)], 1)
        sky.log_radiance.add_(to_map.T)
        if scene.views is not None:
            sky.log_radiance.add_(scene.views.add(to_gain.T))
        change = [(t.own - torch.einsum("cpd,cd->cp", t.cross, step)) / t.norm for t in ties]
        log_albedo = (log_albedo + torch.cat(change, 1).T.clamp(-0.5, 0.5)).clamp(-7.0, 0.0)
        costs.append(sum(t.cost for t in ties) / sighting.numel())
    return costs


def in_parts(point: Tensor, metal: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Points [P] in an order in which those of one material lie together, and the index of each
    part of up to NEWTON_CHUNK in it: the parts come at random, for time may end with any.

    Args:
        metal: bool, of all points.
    """
    groups = [point[~metal[point]], point[metal[point]]]
    chunks = [chunk for group in groups for chunk in group.split(NEWTON_CHUNK) if len(chunk)]
    chunks = [chunks[i] for i in torch.randperm(len(chunks))]
    return torch.cat(chunks), list(torch.arange(len(point)).split([len(c) for c in chunks]))


def views_step(scene: Scene, hessian: Tensor, gradient: Tensor, smooth: float) -> bool:
    """Gauss-Newton step of each view's gain and change of the map; False: there is none.

    Args:
        hessian, gradient: [3, B, R + 1, R + 1] and [3, B, R + 1] from `view_equations`, over the
            number of sightings.
    """
    views, sky = scene.views, scene.sky
    assert views is not None
    assert sky is not None
    assert views.sky_weights is not None
    now = views.sky_weights - views.sky_weights.mean(0)  # [B, R, 3]
    now = torch.nn.functional.pad(now.permute(2, 0, 1), (0, 1))
    prior = WEIGHTS_PRIOR * smooth
    hessian.diagonal(dim1=2, dim2=3).add_(prior)
    step = solve_damped(hessian, gradient - prior * now)
    if step is None:
        return False
    step = step.clamp(-1, 1).permute(1, 2, 0)
    sky.log_radiance.add_(views.add(step[:, -1], step[:, :-1]))
    return True


def light_rows(problem: Problem, point: Tensor, sighting: Tensor, roughness: Tensor) -> Rows:
    """Rows for points [P], all of metal or none, sightings [P, V] and roughness [P]."""
    transport, seen = problem.transport, problem.seen
    count, views = sighting.shape
    normal, wo = seen.normal[point][:, None], seen.wo[sighting]
    cosine = (normal @ transport.direction.T).clamp_min(0) * problem.solid_angle  # [P, 1, D]
    share = transport.open[point].float()[:, None] / 255
    blocked = transport.indirect[point].float()  # [P, D, 3]

    def layer(f0: float) -> Tensor:  # [P, V, D]
        of_sightings = normal.expand_as(wo).flatten(0, 1), wo.flatten(0, 1)
        rough = roughness.repeat_interleave(views)
        options = transport.direction, problem.solid_angle, f0
        return specular_response(*of_sightings, rough, *options).view(count, views, -1)

    if problem.metal[point].any():
        shine = layer(0.0)
        by_base = layer(1.0) - shine  # linear in F0
        through = torch.ones(sighting.shape)
    else:
        shine, by_base = layer(brdf.F0), cosine
        through = (1 - brdf.specular_albedo((normal * wo).sum(2), roughness[:, None])) / math.pi
    return Rows(
        by_base * share,
        through,
        shine * share,
        through[..., None] * (by_base @ blocked),
        shine @ blocked,
        problem.target[sighting],
        seen.view[sighting],
    )
