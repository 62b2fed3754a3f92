"""Where the joint solve starts from: roughness and metal under no map yet, by trial."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from univoxel.joint.config import JointConfig, MetalConfig, TrialConfig
from univoxel.joint.metals import find_metal
from univoxel.joint.newton import newton_round_
from univoxel.joint.observations import Decisions, JointProblem
from univoxel.scene import Scene


@dataclass(frozen=True)
class Hypothesis:
    """What is metal, the scene's state under it, and what it leaves of the photographs."""

    lowest: float  # residual with the metal that was assumed, on TrialConfig.points
    decisive: float  # residual with the metal as found, on more points; inf: nothing was solved
    metal: Tensor  # [P] bool, as found
    states: list[dict[str, Any]]  # of the scene's parts


@dataclass(frozen=True)
class Trials:
    """What all trials have in common, and the troubles that they met."""

    scene: Scene
    problem: JointProblem
    cfg: JointConfig
    seconds: float  # of a round on TrialConfig.points
    seed: int  # of the points: the trials differ in nothing but the hypothesis
    parts: Sequence[nn.Module]  # of the scene, that a trial changes
    before: list[dict[str, Any]]  # their states
    troubles: list[str]

    def states(self) -> list[dict[str, Any]]:
        return [copy.deepcopy(part.state_dict()) for part in self.parts]

    def restore_(self, states: list[dict[str, Any]]) -> None:
        """Bring the scene's parts back to these states."""
        for part, state in zip(self.parts, states, strict=True):
            part.load_state_dict(state)

    def residual_(self, metal: Tensor, times: int = 1) -> float:
        """What is left after a round of Newton, which changes the map; inf: nothing was solved.

        Args:
            times: how many times as many points it takes.
        """
        steps = self.cfg.trials.steps if self.cfg.newton_steps else 0
        points = times * self.cfg.trials.points
        cfg = replace(self.cfg, newton_steps=steps, newton_points=points, newton_roughness=0.0)
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(self.seed)
            solved = newton_round_(
                self.scene, self.problem, Decisions(metal), cfg, self.seconds * times
            )
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
    residuals decide. Where all is known to be metal, the best roughness is looked for alone.

    Args:
        seconds: that the rounds of Newton may take together.
    """
    parts = [part for part in (scene.material, problem.sky, scene.views) if part is not None]
    seed = int(torch.randint(2**31, ()))
    before = [copy.deepcopy(part.state_dict()) for part in parts]
    round_seconds = seconds / cfg.trials.rounds
    trials = Trials(scene, problem, cfg, round_seconds, seed, parts, before, [])
    metal = torch.ones_like(decisions.metal)
    best = best_roughness_(trials, metal if cfg.only_metal else decisions.metal)
    if not cfg.only_metal:
        everywhere = best_roughness_(trials, metal)
        if all_metal(best, everywhere, cfg.trials):
            best = everywhere
    if math.isinf(best.decisive):
        trials.restore_(before)
        return decisions, trials.troubles
    trials.restore_(best.states)
    return replace(decisions, metal=best.metal), trials.troubles


@torch.no_grad()
def neutralise_(scene: Scene, problem: JointProblem, cfg: MetalConfig) -> None:
    """Make the map grey in the mean, and the albedo as bright as that of metals.

    Of an object all of metal photographs show the product of map and albedo alone: in each channel
    one may be brighter and the other darker.
    """
    features = scene.field.features_at(problem.observations.position)
    median = scene.material(features)[0].median(0).values
    wanted = median * problem.sky.radiance.mean(0)
    wanted = wanted * (cfg.only_metal_albedo / wanted.max())
    scene.material.shift_albedo(features, wanted)
    problem.sky.log_radiance += (median / wanted).log()


def best_roughness_(trials: Trials, metal: Tensor) -> Hypothesis:
    """The hypothesis of the best roughness with this metal, and of the metals under its map. It
    leaves the scene in its state."""
    scene, problem, cfg = trials.scene, trials.problem, trials.cfg
    lowest, states = math.inf, trials.before
    for roughness in (None, *cfg.trials.roughness):
        trials.restore_(trials.before)
        if roughness is not None:
            features = scene.field.features_at(problem.observations.position)
            scene.material.shift_roughness(features, roughness)
        residual = trials.residual_(metal)
        if residual < (lowest if roughness is None else cfg.trials.better * lowest):
            lowest, states = residual, trials.states()
    trials.restore_(states)
    # Under a map for metals dielectrics stand out at once: the last threshold serves
    metal = find_metal(scene, problem, cfg, float(metal.all()))
    decisive = trials.residual_(metal, cfg.trials.deciding)
    return Hypothesis(lowest, decisive, metal, trials.states())


def all_metal(before: Hypothesis, everywhere: Hypothesis, cfg: TrialConfig) -> bool:
    """Whether metal everywhere led to the better hypothesis."""
    if everywhere.metal.float().mean() <= cfg.majority:
        return everywhere.decisive < cfg.all_metal * before.decisive
    # A round may end badly by chance: one good one is enough
    return (
        everywhere.decisive < cfg.mostly_metal * before.decisive
        or everywhere.lowest < cfg.mostly_metal * before.lowest
    )
