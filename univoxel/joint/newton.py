"""Gauss-Newton steps on the environment map, albedo and roughness eliminated."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from univoxel import brdf
from univoxel.fields.heads import MaterialHead
from univoxel.joint.config import JointConfig
from univoxel.joint.equations import (
    Differs,
    Rougher,
    Rows,
    Tie,
    free_roughness,
    graph_laplacian,
    normal_equations,
    solve_damped,
    view_differences,
    view_equations,
)
from univoxel.joint.observations import LEAST_VIEWS, Problem, sightings_of, widened
from univoxel.ops import specular_response
from univoxel.scene import Scene

NEWTON_CHUNK = 256  # points whose equations are built at once
WEIGHTS_PRIOR = 10.0  # on changes of a view's map, in units of the Laplacian's weight
UNSOLVABLE = "the equations for the map have no solution: it stays as it is in this round"
NOISE = 0.02  # sRGB; what is left of a sighting
DIFFERENCE = 0.02  # of roughness, that its slopes are taken over
LEAST_CHUNKS = 2  # on a machine however slow


@dataclass
class Points:
    """What a round of Newton looks at, and what it supposes of their materials by now."""

    problem: Problem
    point: Tensor  # [P] int64, those of one material together
    sighting: Tensor  # [P, V] int64
    parts: list[Tensor]  # index into these, of points whose equations are built at once
    log_albedo: Tensor  # [P, 3]
    roughness: Tensor  # [P]
    likely: Tensor  # [P] roughness as it was
    pull: float  # on its squared distance from there, >= 0; 0: roughness stays

    def keep(self, parts: int) -> None:
        """Only the first parts."""
        self.parts = self.parts[:parts]
        kept = slice(sum(map(len, self.parts)))
        for name in ("point", "sighting", "log_albedo", "roughness", "likely"):
            setattr(self, name, getattr(self, name)[kept])

    def rows(self, part: Tensor, rougher: float = 0.0) -> Rows:
        roughness = self.roughness[part] + rougher
        shown = widened(roughness, len(self.problem.transport.direction))
        return light_rows(self.problem, self.point[part], self.sighting[part], shown)

    def equations(
        self, part: Tensor, light: Tensor, differs: Differs | None
    ) -> tuple[Tensor, Tensor, Tie]:
        """Of a part under the map [D, 3], see `normal_equations`."""
        state = self.rows(part), light, self.log_albedo[part], differs
        if not self.pull:
            return normal_equations(*state)
        away = (self.roughness - self.likely)[part]
        rougher = Rougher(self.rows(part, DIFFERENCE), DIFFERENCE, self.pull, away)
        return normal_equations(*state, rougher)

    def follow(self, ties: list[Tie], step: Tensor) -> None:
        """Move albedo and roughness as a step of the light [3, D + B] wants it."""
        steps = zip(*(tie.follow(step) for tie in ties), strict=True)
        to_albedo, to_roughness = (torch.cat(x) for x in steps)
        self.log_albedo = (self.log_albedo + to_albedo.clamp(-0.5, 0.5)).clamp(-7.0, 0.0)
        moved = self.roughness + to_roughness.clamp(-0.1, 0.1)
        self.roughness = moved.clamp(MaterialHead.min_roughness, 1.0)


@torch.no_grad()
def newton_round(
    scene: Scene,
    problem: Problem,
    cfg: JointConfig,
    seconds: float = math.inf,
    tell: Callable[[str], None] = print,
) -> list[float]:
    """Gauss-Newton steps on the log map, with albedo and roughness of every point eliminated.

    The normal equations for log map, log albedo and roughness of the points are block diagonal in
    the materials; their Schur complement is 3 D x 3 D. What then speaks for the map is only what no
    material can explain: how a point's brightness changes from view to view, and with it the
    absolute scale, from highlights of known reflectance. Were roughness fixed, map and roughness
    would have to follow one another in many small steps: a bright map and rough surfaces look much
    like a dim one and glossy surfaces. Residuals are in sRGB-encoded colour with Cauchy weights; a
    graph Laplacian keeps the log map smooth. Where light varies, the views' log gains are solved
    for together with the map, and before that, with the map as it is, what each view's map has of
    its own. Returns the mean weighted squared residual before each step.

    Args:
        seconds: wall time that it may take, about: fewer points serve where all would take more.
        tell: called with a sentence where the equations have no solution; then the round is over.
    """
    begin = time.monotonic()
    sky = scene.sky
    assert sky is not None
    points = choose(scene, problem, cfg) if cfg.newton_steps else None
    if points is None:
        return []
    if seconds < math.inf:
        before = time.monotonic()
        points.equations(points.parts[0], sky.radiance, None)
        now = time.monotonic()
        room = (seconds - (now - begin)) / (cfg.newton_steps * max(now - before, 1e-6))
        points.keep(max(LEAST_CHUNKS, int(room)))
    count = points.sighting.numel()
    smooth = cfg.newton_smooth * graph_laplacian(sky.direction)
    unknowns = len(smooth) + (len(scene.views) if scene.views else 0)  # of a channel
    smooth = torch.nn.functional.pad(smooth, 2 * (0, unknowns - len(smooth)))
    costs = []
    for _ in range(cfg.newton_steps):
        differs = view_differences(scene)
        if differs is not None and differs.basis is not None:
            hessian = slope = torch.zeros(())
            for k in points.parts:
                state = points.rows(k), sky.radiance, points.log_albedo[k], differs
                h, g = view_equations(*state)
                hessian, slope = hessian + h / count, slope + g / count
            if not views_step(scene, hessian, slope, cfg.newton_smooth):
                tell(UNSOLVABLE)
                break
            differs = view_differences(scene)
        x = sky.log_radiance.T  # [3, D]
        if problem.sun is not None:
            x = x - problem.sun.T
        x = torch.nn.functional.pad(x, (0, unknowns - x.shape[1]))  # no gain is likelier than 1
        system, right, ties = smooth, -x @ smooth, []
        between = torch.zeros(())  # channels, which roughness ties to one another
        for k in points.parts:  # added up at once: all would take much memory
            h, g, tie = points.equations(k, sky.radiance, differs)
            if tie.roughness is not None:
                taken, less = free_roughness(tie.roughness)
                between, g = between + taken / count, g - less
            system, right = system + h / count, right + g / count
            ties.append(tie)
        system.diagonal(dim1=1, dim2=2).add_(cfg.newton_smooth)
        if points.pull:
            system, right = torch.block_diag(*system) - between, right.flatten()
        step = solve_damped(system, right)
        if step is None:
            tell(UNSOLVABLE)
            break
        step = step.view(3, unknowns).clamp(-1, 1)
        to_map, to_gain = step.split([len(sky.direction), unknowns - len(sky.direction)], 1)
        sky.log_radiance.add_(to_map.T)
        if scene.views is not None:
            sky.log_radiance.add_(scene.views.add(to_gain.T))
        points.follow(ties, step)
        costs.append(sum(tie.cost for tie in ties) / count)
    return costs


def choose(scene: Scene, problem: Problem, cfg: JointConfig) -> Points | None:
    """Random points that are seen often, with the scene's materials; None: there are none."""
    counts = problem.seen.offsets.diff()
    # Points that are seen as often as usual: of few photographs that is less than is wanted
    usual = float(counts[counts > 0].float().median())
    least = max(LEAST_VIEWS, min(cfg.newton_views // 2, usual))
    rich = (counts >= least).nonzero()[:, 0]
    chosen = rich[torch.randperm(len(rich))[: cfg.newton_points]]
    if not len(chosen):
        return None
    chosen, parts = in_parts(chosen, problem.metal)
    features = scene.field.features_at(problem.seen.position[chosen])
    albedo, roughness, _ = scene.material(features)
    if problem.albedo is not None:
        albedo = problem.albedo[chosen]
    log_albedo = albedo.clamp_min(1e-3).log()
    sighting = sightings_of(problem, chosen, cfg.newton_views)
    pull = (NOISE / cfg.newton_roughness) ** 2 if cfg.newton_roughness else 0.0
    return Points(problem, chosen, sighting, parts, log_albedo, roughness, roughness, pull)


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
