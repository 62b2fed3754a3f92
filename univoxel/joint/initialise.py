"""Where the joint solve starts from: roughness and metal under no map yet, by trial."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from univoxel.config import JointConfig
from univoxel.joint.metals import find_metal
from univoxel.joint.newton import newton_round_
from univoxel.joint.observations import Decisions, JointProblem
from univoxel.scene import Scene

# Points of a round. Of a third of them residuals scatter more than they differ
TRIAL_POINTS = 300
# Newton steps of a round; after three, from no map, too glossy still fits better than right
TRIAL_STEPS = 6
# Medians of roughness that are tried beside the present one
TRIAL_ROUGHNESS = (0.25, 0.7)
# Rounds of Newton in all trials, at most
TRIAL_ROUNDS = 2 * (len(TRIAL_ROUGHNESS) + 2)
# Share of the lowest residual so far that another roughness must not exceed
BETTER = 0.9
# Times the others' residual that metal everywhere must not exceed for all to be metal: 0.6 to 1.1
# where all is, 1.2 and more where some or nothing is, unless grain, fur or mixed lights leave
# much to either. Most points have to look like metal then too, see MAJORITY
ONLY_METAL = 1.15
# Median of roughness from which metal looks like paint and does not count there
LIKE_PAINT = 0.5
# Share of the others' residual that it must not exceed to start from its metals
ALL_METAL = 0.8
# The same, where most is found to be metal under its map. Of objects all of metal 0.67 to 0.93
# is; of dielectrics hardly ever as much
MOSTLY_METAL = 0.95
# Share of the points that are most of them: look like metal for all to be metal, and for
# MOSTLY_METAL. Under a map for metal 0.9 do where all is, 0.34 at most elsewhere
MAJORITY = 0.5
# Median of the brightest channel where all is metal: nothing else tells how bright the light is
ONLY_METAL_ALBEDO = 0.3


@dataclass(frozen=True)
class Hypothesis:
    """What is metal, the scene's state under it, and what it leaves of the photographs."""

    residual: float  # inf: nothing was solved
    metal: Tensor  # [P] bool
    states: list[dict[str, Any]]  # of the scene's parts
    roughness: float  # median, [0, 1]


@dataclass(frozen=True)
class Trials:
    """What all trials have in common, and the troubles that they met."""

    scene: Scene
    problem: JointProblem
    cfg: JointConfig
    seconds: float  # of a round on TRIAL_POINTS
    seed: int  # of the points: the trials differ in nothing but the hypothesis
    parts: Sequence[nn.Module]  # of the scene, that a trial changes
    initial: list[dict[str, Any]]  # their states
    troubles: list[str]

    def states(self) -> list[dict[str, Any]]:
        return [copy.deepcopy(part.state_dict()) for part in self.parts]

    def restore_(self, states: list[dict[str, Any]]) -> None:
        """Bring the scene's parts back to these states."""
        for part, state in zip(self.parts, states, strict=True):
            part.load_state_dict(state)

    def residual_(self, metal: Tensor) -> float:
        """What is left after a round of Newton, which changes the map; inf: nothing was solved."""
        steps = TRIAL_STEPS if self.cfg.newton_steps else 0
        points = TRIAL_POINTS
        cfg = replace(self.cfg, newton_steps=steps, newton_points=points, newton_roughness=0.0)
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(self.seed)
            solved = newton_round_(self.scene, self.problem, Decisions(metal), cfg, self.seconds)
        self.troubles.extend(solved.troubles)
        return solved.costs[-1] if solved.costs else math.inf


def initialise_(
    scene: Scene, problem: JointProblem, decisions: Decisions, cfg: JointConfig, seconds: float
) -> tuple[Decisions, list[str]]:
    """Change the scene's map and roughness to those of the best hypothesis; return the decisions
    with its metal, and sentences about rounds that had no solution.

    Light and material are found from one another. Under a roughness that is wrong everywhere the
    map becomes too sharp or too dull for any other. Where all is metal, a map for dielectrics is so
    bright that nothing looks like metal under it. So rounds of Newton start from what the stages
    before took for metal and from metal everywhere, each with the roughness of the stages before
    and with some others, as a whole. Metals are found under the best map of either, and the
    residuals decide, unless there is nothing but metal.

    Args:
        seconds: that the rounds of Newton may take together.
    """
    parts = [part for part in (scene.material, problem.sky, scene.views) if part is not None]
    seed = int(torch.randint(2**31, ()))
    initial = [copy.deepcopy(part.state_dict()) for part in parts]
    round_seconds = seconds / TRIAL_ROUNDS
    trials = Trials(scene, problem, cfg, round_seconds, seed, parts, initial, [])
    everywhere = tried_roughnesses_(trials, torch.ones_like(decisions.metal))
    best, only_metal = the_best(everywhere), bool(cfg.only_metal)
    if not only_metal:
        before = the_best(tried_roughnesses_(trials, decisions.metal))
        found = under_its_map_(trials, before)
        # Under a light for each photograph what is mirrored may be anything
        one_light = scene.views is None or scene.views.sky_weights is None
        if cfg.only_metal is None and one_light:
            explained = min(before.residual, found.residual)
            only_metal = nothing_but_metal_(trials, explained, everywhere)
        if not only_metal:
            best = under_its_map_(trials, best)
            best = best if better_metals(found, best) else found
    if math.isinf(best.residual):
        trials.restore_(initial)
        return decisions, trials.troubles
    trials.restore_(best.states)
    return replace(decisions, metal=best.metal, only_metal=only_metal), trials.troubles


@torch.no_grad()
def neutralise_(scene: Scene, problem: JointProblem) -> None:
    """Make the map grey in the mean, and the albedo as bright as that of metals.

    Of an object all of metal photographs show the product of map and albedo alone: in each channel
    one may be brighter and the other darker.
    """
    features = scene.field.features_at(problem.observations.position)
    median = scene.material(features)[0].median(0).values
    wanted = median * problem.sky.radiance.mean(0)
    wanted = wanted * (ONLY_METAL_ALBEDO / wanted.max())
    scene.material.shift_albedo(features, wanted)
    problem.sky.log_radiance += (median / wanted).log()


@torch.no_grad()
def tried_roughnesses_(trials: Trials, metal: Tensor) -> list[Hypothesis]:
    """A hypothesis with this metal for the present roughness, and for each that is tried."""
    scene, tried = trials.scene, []
    features = scene.field.features_at(trials.problem.observations.position)
    for roughness in (None, *TRIAL_ROUGHNESS):
        trials.restore_(trials.initial)
        if roughness is not None:
            scene.material.shift_roughness(features, roughness)
        median = float(scene.material(features)[1].median())
        tried.append(Hypothesis(trials.residual_(metal), metal, trials.states(), median))
    return tried


def the_best(tried: Sequence[Hypothesis]) -> Hypothesis:
    """That of the lowest residual; another roughness than the first has to be worth it."""
    best = tried[0]
    for hypothesis in tried[1:]:
        if hypothesis.residual < BETTER * best.residual:
            best = hypothesis
    return best


def nothing_but_metal_(trials: Trials, explained: float, everywhere: Sequence[Hypothesis]) -> bool:
    """Whether metal everywhere explains the photographs about as well as metal as it was found, and
    most points, however dark, look like metal under its map. It may change the scene's state.

    It has no diffuse light to explain them with, and so the fewer ways. Where it is rough, its
    highlights are as wide as diffuse light, and it explains paint. Grain, fur or lights that change
    leave so much to either that their residuals are alike; point by point paint still looks no more
    like metal.

    Args:
        explained: residual of metal as it was found.
    """
    cfg = trials.cfg
    smooth = [h for h in everywhere if h.roughness < LIKE_PAINT]
    best = min(smooth, key=lambda h: h.residual, default=None)
    if best is None or not best.residual < ONLY_METAL * explained:
        return False
    trials.restore_(best.states)
    however_dark = replace(cfg, metal=replace(cfg.metal, min_reflectance=0.0))
    metal = find_metal(trials.scene, trials.problem, however_dark, 1.0)
    return bool(metal.float().mean() > MAJORITY)


def under_its_map_(trials: Trials, assumed: Hypothesis) -> Hypothesis:
    """The hypothesis of the metals that are found under the map of another one. It leaves the scene
    in its state."""
    trials.restore_(assumed.states)
    # Under a map for metals dielectrics stand out at once: the last threshold serves
    done = float(assumed.metal.all())
    metal = find_metal(trials.scene, trials.problem, trials.cfg, done)
    return Hypothesis(trials.residual_(metal), metal, trials.states(), assumed.roughness)


def better_metals(before: Hypothesis, everywhere: Hypothesis) -> bool:
    """Whether the metals that were found from metal everywhere are the better ones."""
    mostly = everywhere.metal.float().mean() > MAJORITY
    share = MOSTLY_METAL if mostly else ALL_METAL
    return everywhere.residual < share * before.residual
