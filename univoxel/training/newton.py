"""Gauss-Newton steps on the environment map, albedo and roughness eliminated."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch
from torch import Tensor

from univoxel import brdf
from univoxel.color import CLIPPED, linear_to_srgb_unclipped
from univoxel.config import JointConfig
from univoxel.fields.field import MaterialHead
from univoxel.ops import specular_response
from univoxel.render.observations import (
    JointProblem,
    MaterialLabels,
    observations_of,
    prefiltered_roughness,
    unfiltered_roughness,
)
from univoxel.scene import Scene
from univoxel.training import equations

# Observations that a point needs: in a single one its colour explains everything
MIN_VIEWS = 2
# sRGB; the scale of the Cauchy weights: residuals beyond are what no model explains
CAUCHY = 0.05
# sRGB; what is left of an observation under the true map and materials. It weighs the prior of
# roughness against the observations
NOISE = 0.02
# Standard deviation of the prior by which the roughness of a point follows the map
FOLLOWS = 0.1
# Roughness over which slopes by roughness are taken
ROUGHNESS_STEP = 0.02
# Log radiance by which a step changes a node of the map, or a view's gain, at most
MAX_MAP_CHANGE = 1.0
# Log albedo by which a step changes a point at most
MAX_ALBEDO_CHANGE = 0.5
# Roughness by which a step changes a point at most
MAX_ROUGHNESS_CHANGE = 0.1
# Log albedo below which no point goes: what is blacker does not determine the light
MIN_LOG_ALBEDO = -7.0
# Weight of the prior on changes of a view's own map, in units of newton_smooth
VIEW_PRIOR = 10.0
# Natural log by which a channel of the whole map may differ from the others, where the colours of
# paint do not tell: the prior of a white light weighs as much as one observation of each point
TINT = 0.5
# Nearest nodes of the map that the smoothness ties a node to: as many as lie around one
NODE_NEIGHBOURS = 6
# Observations of a point that a round is judged by
UNSEEN_VIEWS = 16
# Parts of the points that a step builds its equations from on a machine however slow
MIN_PARTS = 2


NEWTON_CHUNK = 256  # points whose equations are built at once
UNSOLVABLE = "the environment map is unchanged in this round: its equations have no solution"


@dataclass(frozen=True)
class NewtonRound:
    """What a round came to."""

    costs: list[float] = field(default_factory=list)  # mean weighted squared residual by step
    unseen: float = math.inf  # mean robust cost of observations that were not used; inf: of none
    level: float = 0.0  # second derivative of the cost by the log brightness of the whole map
    to_roughness: float = 0.0  # what the points' median roughness changed by, as the map did
    troubles: list[str] = field(default_factory=list)  # sentences about what had no solution


@dataclass
class NewtonPoints:
    """Points P of a round, V observations of each, and their materials as the steps have them."""

    ARRAYS: ClassVar[tuple[str, ...]] = (  # with a row for each point
        *("metal", "point", "observation", "log_albedo", "roughness", "prior_roughness"),
    )

    problem: JointProblem
    metal: Tensor  # [P] bool
    point: Tensor  # [P] int64, those of one material together
    observation: Tensor  # [P, V] int64
    parts: list[Tensor]  # index into these, of points whose equations are built at once
    log_albedo: Tensor  # [P, 3]
    roughness: Tensor  # [P]
    prior_roughness: Tensor  # [P] roughness as it was

    @property
    def count(self) -> int:
        """Number of observations that the equations are a mean over."""
        return self.observation.numel()

    def keep_(self, parts: int) -> None:
        """Keep only the first parts."""
        self.parts = self.parts[:parts]
        kept = slice(sum(map(len, self.parts)))
        for name in self.ARRAYS:
            setattr(self, name, getattr(self, name)[kept])

    def transport(self, part: Tensor, roughness_step: float = 0.0) -> equations.LinearTransport:
        """Of a part, where its roughness is larger by the step."""
        roughness = self.roughness[part] + roughness_step
        roughness = prefiltered_roughness(roughness, self.problem.nodes)
        metal = bool(self.metal[part].any())
        point, observation = self.point[part], self.observation[part]
        return linear_transport(self.problem, point, observation, roughness, metal)

    def equations(
        self, part: Tensor, differences: equations.ViewDifferences | None
    ) -> tuple[Tensor, Tensor, equations.EliminatedAlbedo]:
        """Of a part under the present map, see `normal_equations`."""
        state = self.transport(part), self.problem.sky.radiance, self.log_albedo[part], CAUCHY
        rougher = self.transport(part, ROUGHNESS_STEP)
        prior, deviation = (NOISE / FOLLOWS) ** 2, (self.roughness - self.prior_roughness)[part]
        step = equations.RoughnessStep(rougher, ROUGHNESS_STEP, prior, deviation)
        return equations.normal_equations(*state, differences, step)

    def step_(self, eliminated: list[equations.EliminatedAlbedo], light_step: Tensor) -> None:
        """Change albedo and roughness as it belongs to a step of the light [3, D + B]."""
        steps = zip(*(e.back_substituted(light_step) for e in eliminated), strict=True)
        to_albedo, to_roughness = (torch.cat(x) for x in steps)
        limit = MAX_ALBEDO_CHANGE
        log_albedo = self.log_albedo + to_albedo.clamp(-limit, limit)
        self.log_albedo = log_albedo.clamp(MIN_LOG_ALBEDO, 0.0)
        limit = MAX_ROUGHNESS_CHANGE
        roughness = self.roughness + to_roughness.clamp(-limit, limit)
        self.roughness = roughness.clamp(MaterialHead.min_roughness, 1.0)


@torch.no_grad()
def newton_round_(
    scene: Scene,
    problem: JointProblem,
    decisions: MaterialLabels,
    cfg: JointConfig,
    seconds: float = math.inf,
    unseen: JointProblem | None = None,
) -> NewtonRound:
    """Change the scene's map, and what its views differ by, in Gauss-Newton steps; return their
    costs. Albedo and roughness of every point are eliminated: the materials stay.

    The normal equations for log map, log albedo and roughness of the points are block diagonal in
    the materials; their Schur complement is 3 D x 3 D. What it leaves is what no material can
    explain: how a point's brightness changes from view to view, and with it the absolute scale,
    from highlights of known reflectance. Were roughness fixed, map and roughness would have to
    follow one another in many small steps: a bright map and rough surfaces look much like a dim one
    and glossy surfaces. Residuals are in sRGB-encoded colour with Cauchy weights; a graph Laplacian
    keeps the log map smooth. Where light varies, the views' log gains are solved for together with
    the map, and before that, with the map as it is, what each view's map has of its own.

    Args:
        seconds: wall time that it may take, about: it takes fewer points where all would take more.
        unseen: the same points in other observations, which the result is judged by.
    """
    begin = time.monotonic()
    points = choose_points(scene, problem, decisions, cfg) if cfg.newton_steps else None
    if points is None:
        return NewtonRound()
    if seconds < math.inf:
        part_begin = time.monotonic()
        points.equations(points.parts[0], None)
        part_end = time.monotonic()
        part_seconds = max(part_end - part_begin, 1e-6)
        parts_in_time = (seconds - (part_end - begin)) / (cfg.newton_steps * part_seconds)
        points.keep_(max(MIN_PARTS, int(parts_in_time)))
    laplacian = cfg.newton_smooth * equations.graph_laplacian(
        problem.sky.direction, NODE_NEIGHBOURS
    )
    costs, level = [], 0.0
    for _ in range(cfg.newton_steps):
        differences = equations.view_differences(scene)
        if differences is not None and differences.basis is not None:
            if not views_step_(scene, points, differences, cfg.newton_smooth):
                return NewtonRound(costs, troubles=[UNSOLVABLE])
            differences = equations.view_differences(scene)
        sun, damping = decisions.sun, cfg.newton_smooth
        made = map_step_(scene, points, differences, sun, laplacian, damping)
        if made is None:
            return NewtonRound(costs, troubles=[UNSOLVABLE])
        costs.append(made[0])
        level = made[1]
    to_roughness = float(points.roughness.median() - points.prior_roughness.median())
    left = math.inf if unseen is None else unseen_cost(scene, points, unseen)
    return NewtonRound(costs, left, level, to_roughness)


def unseen_cost(scene: Scene, points: NewtonPoints, unseen: JointProblem) -> float:
    """Mean Cauchy cost of points, as a round left them, in other observations of them; inf: there
    are none."""
    counts = unseen.observations.offsets.diff()[points.point]
    if not counts.any():
        return math.inf
    observation = observations_of(unseen, points.point, UNSEEN_VIEWS)
    observation = observation.clamp_max(len(unseen.target) - 1)  # of points that have none
    points = replace(points, problem=unseen, observation=observation)
    differences, sky = equations.view_differences(scene), unseen.sky.radiance
    costs = torch.zeros(len(counts))
    for part in points.parts:
        transport = points.transport(part)
        state = transport, sky, points.log_albedo[part]
        channels = [equations.channel_radiance(*state, c, differences)[1] for c in range(3)]
        residual = transport.target - linear_to_srgb_unclipped(torch.stack(channels, 2))
        residual = residual.masked_fill((transport.target > CLIPPED) & (residual < 0), 0.0)
        costs[part] = CAUCHY**2 * torch.log1p((residual / CAUCHY).square()).mean((1, 2))
    return float(costs[counts > 0].mean())


def choose_points(
    scene: Scene, problem: JointProblem, decisions: MaterialLabels, cfg: JointConfig
) -> NewtonPoints | None:
    """Random points that are seen often, with the scene's materials; None: there are none."""
    counts = problem.observations.offsets.diff()
    # Points that are seen as often as usual: of few photographs that is less than is wanted
    usual_count = float(counts[counts > 0].float().median())
    min_count = max(MIN_VIEWS, min(cfg.newton_views // 2, usual_count))
    candidates = (counts >= min_count).nonzero()[:, 0]
    point = candidates[torch.randperm(len(candidates))[: cfg.newton_points]]
    if not len(point):
        return None
    point, parts = in_parts(point, decisions.metal)
    features = scene.field.features_at(problem.observations.position[point])
    albedo, roughness, _ = scene.material(features)
    if decisions.albedo is not None:
        albedo = decisions.albedo[point]
    return NewtonPoints(
        problem,
        decisions.metal[point],
        point,
        observations_of(problem, point, cfg.newton_views),
        parts,
        log_albedo=albedo.clamp_min(1e-3).log(),
        roughness=roughness,
        prior_roughness=roughness,
    )


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


def map_step_(
    scene: Scene,
    points: NewtonPoints,
    differences: equations.ViewDifferences | None,
    sun: Tensor | None,
    laplacian: Tensor,
    damping: float,
) -> tuple[float, float] | None:
    """Change the map, the views' gains and the points' materials by one step; return the cost
    before it and the `NewtonRound.level`, or None if the equations have no solution and all stays.

    Args:
        sun: [D, 3] what a sun adds to the log map: it is no want of smoothness.
        laplacian: [D, D] with its weight.
        damping: weight of the squared step.
    """
    sky, count = points.problem.sky, points.count
    nodes, gains = len(laplacian), len(scene.views) if scene.views else 0
    unknowns = nodes + gains + (scene.flash is not None)  # of a channel
    laplacian = torch.nn.functional.pad(laplacian, 2 * (0, unknowns - nodes))
    log_map = sky.log_radiance.T  # [3, D]
    if sun is not None:
        log_map = log_map - sun.T
    log_map = torch.nn.functional.pad(log_map, (0, unknowns - nodes))  # no gain is likelier than 1
    system, right_side = laplacian, -log_map @ laplacian
    if points.problem.turned is not None:  # see `painted_points`
        mean = (torch.arange(unknowns) < nodes) / nodes
        prior = (NOISE / TINT) ** 2 * mean
        tint = log_map @ mean
        system = system + prior[:, None] * mean
        right_side = right_side + (tint.mean() - tint)[:, None] * prior
    eliminated = []
    coupling = torch.zeros(())  # of the channels, by roughness
    for part in points.parts:  # added up at once: all would take much memory
        hessian, gradient, albedo = points.equations(part, differences)
        assert albedo.roughness is not None
        hessian_part, gradient_part = equations.roughness_terms(albedo.roughness)
        coupling, gradient = coupling + hessian_part / count, gradient - gradient_part
        system, right_side = system + hessian / count, right_side + gradient / count
        eliminated.append(albedo)
    brighter = (torch.arange(unknowns) < nodes).float().repeat(3)
    level = float(brighter @ (torch.block_diag(*system) - coupling) @ brighter)
    system.diagonal(dim1=1, dim2=2).add_(damping)
    system, right_side = torch.block_diag(*system) - coupling, right_side.flatten()
    tied = None
    if scene.flash is not None:  # one for all channels
        first, *others = (unknowns * torch.arange(1, 4) - 1).tolist()
        tied = torch.eye(len(right_side))
        tied[others, first] = 1.0
        tied = tied[:, [k for k in range(len(right_side)) if k not in others]]
        system, right_side = tied.T @ system @ tied, tied.T @ right_side
    step = equations.solve_damped(system, right_side)
    if step is None:
        return None
    if tied is not None:
        step = tied @ step
    limit = MAX_MAP_CHANGE
    step = step.view(3, unknowns).clamp(-limit, limit)
    to_map, to_gain, to_flash = step.split([nodes, gains, unknowns - nodes - gains], 1)
    sky.log_radiance.add_(to_map.T)
    if scene.views is not None:
        sky.log_radiance.add_(scene.views.add(to_gain.T))
    if scene.flash is not None:
        scene.flash.log_radiance.add_(to_flash[0])
    points.step_(eliminated, step)
    return sum(albedo.cost for albedo in eliminated) / count, level


def views_step_(
    scene: Scene, points: NewtonPoints, differences: equations.ViewDifferences, smooth: float
) -> bool:
    """Change each view's gain and its change of the map by one step; return False if the equations
    have no solution and all stays.

    Args:
        smooth: weight of the map's Laplacian.
    """
    views, sky, count = scene.views, points.problem.sky, points.count
    assert views is not None
    assert views.sky_weights is not None
    hessian = gradient = torch.zeros(())
    for part in points.parts:
        state = points.transport(part), sky.radiance, points.log_albedo[part], CAUCHY
        part_hessian, part_gradient = equations.view_equations(*state, differences)
        hessian, gradient = hessian + part_hessian / count, gradient + part_gradient / count
    weights = views.sky_weights - views.sky_weights.mean(0)  # [B, R, 3]
    weights = torch.nn.functional.pad(weights.permute(2, 0, 1), (0, 1))
    prior = VIEW_PRIOR * smooth
    hessian.diagonal(dim1=2, dim2=3).add_(prior)
    step = equations.solve_damped(hessian, gradient - prior * weights)
    if step is None:
        return False
    limit = MAX_MAP_CHANGE
    step = step.clamp(-limit, limit).permute(1, 2, 0)
    sky.log_radiance.add_(views.add(step[:, -1], step[:, :-1]))
    return True


def linear_transport(
    problem: JointProblem, point: Tensor, observation: Tensor, roughness: Tensor, metal: bool
) -> equations.LinearTransport:
    """Of points [P], all of metal or none, in observations [P, V], with roughness [P]."""
    transport, observations = problem.transport, problem.observations
    count, views = observation.shape
    normal, wo = observations.normal[point][:, None], observations.wo[observation]
    cosine = (normal @ transport.direction.T).clamp_min(0) * problem.solid_angle  # [P, 1, D]
    visibility = transport.visibility[point].float()[:, None] / 255
    indirect = transport.indirect[point].float()  # [P, D, 3]

    def specular_layer(f0: float) -> Tensor:  # [P, V, D]
        normal_and_wo = normal.expand_as(wo).flatten(0, 1), wo.flatten(0, 1)
        repeated = roughness.repeat_interleave(views)
        options = transport.direction, problem.solid_angle, f0
        return specular_response(*normal_and_wo, repeated, *options).view(count, views, -1)

    if metal:
        specular = specular_layer(0.0)
        by_base = specular_layer(1.0) - specular  # linear in F0
        factor = torch.ones(observation.shape)
    else:
        specular, by_base = specular_layer(brdf.F0), cosine
        factor = (1 - brdf.specular_albedo((normal * wo).sum(2), roughness[:, None])) / math.pi
    view = observations.view[observation]
    return equations.LinearTransport(
        from_map(problem, by_base * visibility, view),
        factor,
        from_map(problem, specular * visibility, view),
        factor[..., None] * (by_base @ indirect),
        specular @ indirect,
        problem.target[observation],
        view,
        flash_transport(problem, point, observation, roughness, metal),
    )


def flash_transport(
    problem: JointProblem, point: Tensor, observation: Tensor, roughness: Tensor, metal: bool
) -> Tensor | None:
    """Radiance [2, P, V, 3] that the flash makes points send, for base 1 and what does not depend
    on it; None: there is no flash. Arguments as in `linear_transport`."""
    flash = problem.flash
    if flash is None:
        return None
    observations, views = problem.observations, observation.shape[1]
    index, flat = point.repeat_interleave(views), observation.flatten()
    away = observations.away(index, flat)
    seen = observations.normal[index], observations.wo[flat], away
    sharp = unfiltered_roughness(roughness, problem.nodes).repeat_interleave(views)

    def of(diffuse: float, f0: float) -> Tensor:
        white = torch.ones_like(seen[0])
        shown = flash.reflected(*seen, diffuse * white, sharp, f0 * white)
        return shown.view(*observation.shape, 3)

    beside = of(0.0, 0.0 if metal else brdf.F0)
    return torch.stack([(of(0.0, 1.0) if metal else of(1.0, brdf.F0)) - beside, beside])


def from_map(problem: JointProblem, from_world: Tensor, view: Tensor) -> Tensor:
    """Transport [P, 1 or V, D] from directions in the world, as from the nodes of the map: [P, V,
    D] where it turns with the camera, as it is elsewhere.

    Args:
        view: [P, V] photographs.
    """
    if problem.turned is None:
        return from_world
    position = problem.turned.position[view].flatten()
    rows = from_world.expand(*view.shape, -1).flatten(0, 1)
    turned = torch.empty_like(rows)
    for at in position.unique().tolist():
        of_position = (position == at).nonzero()[:, 0]
        turned[of_position] = rows[of_position] @ problem.turned.weights[at]
    return turned.view(*view.shape, -1)
