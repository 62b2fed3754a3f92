"""Metal classification of surface points, and the initialisation of the joint optimisation."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from scipy.spatial import KDTree
from torch import Tensor, nn

from univoxel.brdf import F0
from univoxel.color import CLIPPED, linear_to_srgb_unclipped, srgb_slope, srgb_to_linear
from univoxel.config import JointConfig
from univoxel.render.observations import (
    JointProblem,
    MaterialLabels,
    halves,
    observations_of,
    prefiltered_roughness,
    shade_observations,
)
from univoxel.scene import Scene
from univoxel.training.newton import CAUCHY, MIN_VIEWS, newton_round_

# Which points of the surface are metal, by what either material would have to look like.
#
# Descending from one to the other fails: between a base under a dull layer and a coloured mirror
# lie materials that look like neither. Under a known light either is one unknown base colour a
# roughness, so both are fitted and their residuals compared.


# Roughnesses that are tried, from a mirror to chalk
ROUGHNESSES = (0.1, 0.2, 0.3, 0.45, 0.65, 0.9)
# Gauss-Newton steps on a base colour
STEPS = 5
# Bounds of a base colour
BASE = (0.005, 1.0)
# Brightest channel of a metal at least: metals in use reflect 0.4 and more
MIN_REFLECTANCE = 0.25
# Points whose evidence is averaged: that of one alone is too noisy
NEIGHBOURS = 32
# Voxels that count as one unit of distance between points
NEAR = 4.0
# Log albedo that counts as one unit of distance between points
ALIKE = 0.5
# Bound of the log ratio of one point: a single one does not decide for its neighbours
MAX_EVIDENCE = 2.0
# Log ratio of residuals, metal over dielectric, below which a point is metal: under the first map
# and under the last. The first asks for more: the map is wrong yet, and metals make the next one.
# Where metal is likely, see LIKELY, less is asked for: of wood the last would make a fifth metal
THRESHOLD = {False: (-0.4, -0.15), True: (-0.3, 0.0)}


def find_metal(
    scene: Scene, problem: JointProblem, cfg: JointConfig, done: float, likely: bool
) -> Tensor:
    """Which of the problem's points are metal under the present map: [P] bool.

    Args:
        done: progress of the map in [0, 1], from the first round of Newton to the last.
        likely: whether the stages before saw metal, see `MaterialLabels`.
    """
    first, last = THRESHOLD[likely]
    return evidence(scene, problem, cfg) < first + done * (last - first)


@torch.no_grad()
def evidence(scene: Scene, problem: JointProblem, cfg: JointConfig) -> Tensor:
    """Log ratio [P] of the residuals of the photographs if a point is metal, over if it is not.

    `cfg.newton_points` of them, in `cfg.newton_views` observations, are fitted as dielectrics and
    as metals, with the best roughness for each. The log ratio of the two residuals is averaged over
    points that are near and of like albedo; the other points take that of the nearest of them. A
    metal has to reflect what metals do: black plastic would pass for a metal that is black.
    """
    position = problem.observations.position
    counts = problem.observations.offsets.diff()
    candidates = (counts >= MIN_VIEWS).nonzero()[:, 0]
    if not len(candidates):
        return torch.zeros(len(counts))
    point = candidates[torch.randperm(len(candidates))[: cfg.newton_points]]
    observation = observations_of(problem, point, cfg.newton_views)
    costs = [residuals(scene, problem, point, observation, r) for r in ROUGHNESSES]
    dielectric, metal = torch.stack(costs).amin(0)
    limit = MAX_EVIDENCE
    ratio = (metal / dielectric).log().clamp(-limit, limit)

    albedo = scene.material(scene.field.features_at(position))[0].clamp_min(1e-2).log()
    scaled = position / (NEAR * problem.voxel_size), albedo / ALIKE
    key = torch.cat(scaled, 1).numpy()
    key_of_point = key[point.numpy()]  # a tensor of one index would be taken for a number
    tree = KDTree(key_of_point)
    count = min(NEIGHBOURS, len(point))
    nearest = tree.query(key_of_point, k=count, workers=-1)[1]
    mean = ratio[torch.from_numpy(nearest).reshape(len(point), -1)].mean(1)
    return mean[torch.from_numpy(tree.query(key, workers=-1)[1])]


def residuals(
    scene: Scene,
    problem: JointProblem,
    point: Tensor,
    observation: Tensor,
    roughness: float,
) -> Tensor:
    """Robust costs [2, P] of points [P] in observations [P, V], as the best dielectric and as the
    best metal of a roughness."""
    count, views = observation.shape
    index, flat = point.repeat_interleave(views), observation.flatten()
    normal = problem.observations.normal[index]
    filtered = prefiltered_roughness(torch.full((len(flat),), roughness), problem.nodes)

    def shaded(diffuse: float, f0: float) -> Tensor:
        white = torch.ones(len(flat), 3)
        args = scene, problem, index, flat, normal, diffuse * white, filtered, f0 * white
        return shade_observations(*args).view(count, views, 3)

    target = problem.target[observation]
    black, mirror = shaded(0.0, 0.0), shaded(0.0, 1.0)  # linear in F0
    specular = black + F0 * (mirror - black)
    dielectric = fitted(specular, shaded(1.0, F0) - specular, target, 0.0)
    metal = fitted(black, mirror - black, target, MIN_REFLECTANCE)
    return torch.stack([dielectric, metal])


def fitted(constant: Tensor, slope: Tensor, target: Tensor, min_brightest: float) -> Tensor:
    """Cauchy costs [P] of constant + base * slope [P, V, 3], at the best base colours, against the
    sRGB-encoded target [P, V, 3].

    Args:
        min_brightest: that a base's brightest channel has at least.
    """

    def within_bounds(base: Tensor) -> Tensor:
        base = base.clamp(*BASE)
        return base * (min_brightest / base.amax(1, keepdim=True)).clamp_min(1.0)

    def linearised() -> tuple[Tensor, Tensor, Tensor]:  # residual, its square by the scale, slope
        radiance = constant + base[:, None] * slope
        residual = target - linear_to_srgb_unclipped(radiance)
        free = (target <= CLIPPED) | (residual > 0)  # clipped pixels are lower bounds
        return free * residual, (free * residual / CAUCHY).square(), srgb_slope(radiance) * slope

    base = (srgb_to_linear(target) - constant).sum(1) / slope.sum(1).clamp_min(1e-6)
    base = within_bounds(base)
    for _ in range(STEPS):
        residual, square, by_base = linearised()
        weighted = by_base / (1 + square)
        step = (weighted * residual).sum(1) / (weighted * by_base).sum(1).clamp_min(1e-6)
        base = within_bounds(base + step)
    return CAUCHY**2 * torch.log1p(linearised()[1]).mean((1, 2)) + 1e-6


# Where the joint optimisation starts from: what is metal, under no map yet, by trial.


# Points of a round. Of a third of them residuals scatter more than they differ
TRIAL_POINTS = 300
# Newton steps of a round; after three, from no map, too glossy still fits better than right
TRIAL_STEPS = 6
# Rounds of Newton in all trials, at most
TRIAL_ROUNDS = 4
# Share of the residual so far that metals which were found again may leave to be taken
BETTER = 0.9
# Times the residual of metal as it was found that metal everywhere may leave for all to be metal:
# where that is unlikely, and where it is likely. It leaves 0.26 of a bronze head that the stages
# before take for paint, 0.6 and more of wood and paint; 1.05 at most of six of seven objects that
# are all metal, and 1.12 and more of others on which metal is likely
ONLY_METAL = (0.4, 1.09)
# Median of the brightest channel where all is metal: nothing else tells how bright the light is
ONLY_METAL_ALBEDO = 0.3


@dataclass(frozen=True)
class Hypothesis:
    """What is metal, the scene's state under it, and what it leaves of the photographs."""

    residual: float  # inf: nothing was solved
    metal: Tensor  # [P] bool
    states: list[dict[str, Any]]  # of the scene's parts


@dataclass(frozen=True)
class Trials:
    """What all trials have in common, and the troubles that they met."""

    scene: Scene
    problem: JointProblem
    halves: tuple[JointProblem, JointProblem]  # the observations that are fitted, and the others
    cfg: JointConfig
    likely: bool  # whether the stages before saw metal
    seconds: float  # of a round on TRIAL_POINTS
    end: float  # by time.monotonic: later no other trial begins
    seed: int  # of the points: the trials differ in nothing but the hypothesis
    parts: Sequence[nn.Module]  # of the scene, that a trial changes
    initial: list[dict[str, Any]]  # their states
    troubles: list[str]

    @property
    def in_time(self) -> bool:
        return time.monotonic() < self.end

    def states(self) -> list[dict[str, Any]]:
        return [copy.deepcopy(part.state_dict()) for part in self.parts]

    def restore_(self, states: list[dict[str, Any]]) -> None:
        """Bring the scene's parts back to these states."""
        for part, state in zip(self.parts, states, strict=True):
            part.load_state_dict(state)

    def residual_(self, metal: Tensor) -> float:
        """What is left of observations that were not used, after a round of Newton on the others,
        which changes the map; inf: nothing was solved."""
        steps = TRIAL_STEPS if self.cfg.newton_steps else 0
        cfg = replace(self.cfg, newton_steps=steps, newton_points=TRIAL_POINTS)
        fitted, unseen = self.halves
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(self.seed)
            solved = newton_round_(
                self.scene, fitted, MaterialLabels(metal), cfg, self.seconds, unseen
            )
        self.troubles.extend(solved.troubles)
        return solved.unseen


def initialise_(
    scene: Scene, problem: JointProblem, decisions: MaterialLabels, cfg: JointConfig, seconds: float
) -> tuple[MaterialLabels, list[str]]:
    """Change the scene's map to that of the best hypothesis; return the decisions with its metal,
    and sentences about rounds that had no solution.

    Light and material are found from one another. If all is metal, a map for dielectrics is so
    bright that nothing looks like metal under it. So rounds of Newton start from what the stages
    before took for metal, and from metal everywhere; under the map of either, metals are found
    again. Each round fits half of the observations. What it leaves of the other half decides,
    because a richer hypothesis always fits better what it was fitted to. If the stages before saw
    metal, metal everywhere only has to explain them about as well, as it has fewer ways to do so.
    If they saw none, it has to explain far more: waxed wood, whose sheen is coloured, looks a
    little more like metal than like paint.

    Args:
        seconds: that the rounds of Newton may take together. Once they are over, the best so far
            stands: a limit of a minute would leave nothing for the materials to follow the map.
    """
    end = time.monotonic() + seconds
    changed = scene.material, problem.sky, scene.views, scene.flash
    parts = [part for part in changed if part is not None]
    seed = int(torch.randint(2**31, ()))
    initial = [copy.deepcopy(part.state_dict()) for part in parts]
    round_seconds = seconds / TRIAL_ROUNDS
    likely = decisions.likely
    trials = Trials(
        scene, problem, halves(problem), cfg, likely, round_seconds, end, seed, parts, initial, []
    )
    only_metal = bool(cfg.only_metal)
    all_metal = torch.ones_like(decisions.metal)
    if only_metal:
        best = assumed_(trials, all_metal)
    else:
        best = assumed_(trials, decisions.metal)
    if not only_metal and trials.in_time:
        best = better_of(best, under_its_map_(trials, best))
    if not only_metal and trials.in_time:
        everywhere = assumed_(trials, all_metal)
        explained = everywhere.residual < ONLY_METAL[likely] * best.residual
        # Under a light for each photograph what is mirrored may be anything
        one_light = scene.views is None or scene.views.sky_weights is None
        only_metal = explained and cfg.only_metal is None and one_light
        if only_metal:
            best = everywhere
        elif explained or likely:
            best = better_of(best, under_its_map_(trials, everywhere))
    if math.isinf(best.residual):
        trials.restore_(initial)
        return decisions, trials.troubles
    trials.restore_(best.states)
    return replace(decisions, metal=best.metal, only_metal=only_metal), trials.troubles


@torch.no_grad()
def neutralise_(scene: Scene, problem: JointProblem) -> None:
    """Make the map grey in the mean, and the albedo as bright as that of metals.

    Of an object all of metal photographs show the product of map and albedo only: in each channel
    one may be brighter and the other darker.
    """
    features = scene.field.features_at(problem.observations.position)
    median = scene.material(features)[0].median(0).values
    wanted = median * problem.sky.radiance.mean(0)
    wanted = wanted * (ONLY_METAL_ALBEDO / wanted.max())
    scene.material.shift_albedo(features, wanted)
    problem.sky.log_radiance += (median / wanted).log()


def assumed_(trials: Trials, metal: Tensor) -> Hypothesis:
    """The hypothesis of this metal, from the state that the trials begin with."""
    trials.restore_(trials.initial)
    return Hypothesis(trials.residual_(metal), metal, trials.states())


def better_of(present: Hypothesis, other: Hypothesis) -> Hypothesis:
    """The other hypothesis if it explains clearly more, else the present one."""
    return other if other.residual < BETTER * present.residual else present


def under_its_map_(trials: Trials, assumed: Hypothesis) -> Hypothesis:
    """The hypothesis of the metals that are found under the map of another one. It leaves the scene
    in its state."""
    trials.restore_(assumed.states)
    # Under a map for metals dielectrics stand out at once: the last threshold serves
    done = float(assumed.metal.all())
    metal = find_metal(trials.scene, trials.problem, trials.cfg, done, trials.likely)
    return Hypothesis(trials.residual_(metal), metal, trials.states())
