"""Where the joint solve starts from: roughness and metal under no map yet, by trial."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from univoxel.joint.config import JointConfig
from univoxel.joint.metals import find_metal
from univoxel.joint.newton import newton_round
from univoxel.joint.observations import Problem
from univoxel.scene import Scene

TRIED = 100  # points of Newton rounds that tell what roughness to suppose
DECIDING = 3  # times as many, of the two that tell whether all is metal
STEPS = 6  # of such a round; after three, from no map, too glossy still looks better than right
ROUGHNESS = (0.25, 0.7)  # medians that are tried beside the present one
BETTER = 0.9  # times the others' residual: what is left if another roughness is to be supposed
# The same of metal everywhere, and where most is then found to be metal: of objects all of metal
# 0.67 to 0.93 is, of dielectrics hardly ever as much
CONVINCING, MOSTLY = 0.8, 0.95
TRIALS = 2 * (1 + len(ROUGHNESS) + DECIDING)  # rounds of Newton of so many points that this takes


class Start(NamedTuple):
    """A supposition, and what of the photographs it leaves unexplained."""

    lowest: float  # with its metal as supposed, on TRIED points
    left: float  # with its metal as found, on DECIDING times as many; inf: nothing was solved
    metal: Tensor  # [P] bool, as found
    states: list[dict]  # of the scene's parts


def supposed(
    scene: Scene, problem: Problem, cfg: JointConfig, seconds: float, tell: Callable[[str], None]
) -> Problem:
    """The problem with its metals, and the scene's map and roughness, from the best supposition.

    Light and material are found from one another: under a roughness that is wrong everywhere the
    map becomes too sharp or too dull for any other, and where all is metal, a map for dielectrics
    is so bright that nothing looks like metal under it. So rounds of Newton start from what the
    stages before took for metal and from metal everywhere, each with the roughness of the stages
    before and with some others, as a whole; metals are found under the best map of either, and the
    residuals decide.

    Args:
        seconds: that the rounds of Newton may take together.
    """
    steps = STEPS if cfg.newton_steps else 0
    few = replace(cfg, newton_steps=steps, newton_roughness=0.0)
    parts = [part for part in (scene.material, scene.sky, scene.views) if part is not None]
    seed = int(torch.randint(2**31, ()))

    def trial(metal: Tensor, share: int = 1) -> float:
        """What is left after a round on share * TRIED points, the same in all such trials."""
        tried, points = replace(problem, metal=metal), replace(few, newton_points=share * TRIED)
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(seed)
            costs = newton_round(scene, tried, points, seconds * share / TRIALS, tell)
        return costs[-1] if costs else math.inf

    def states() -> list[dict]:
        return [copy.deepcopy(part.state_dict()) for part in parts]

    def restore(states: list[dict]) -> None:
        for part, state in zip(parts, states, strict=True):
            part.load_state_dict(state)

    before = states()

    def attempt(metal: Tensor) -> Start:
        """The best roughness with this metal, and the metals under its map."""
        lowest, found = math.inf, before
        for roughness in (None, *ROUGHNESS):
            restore(before)
            if roughness is not None:
                features = scene.field.features_at(problem.seen.position)
                scene.material.shift_roughness(features, roughness)
            left = trial(metal)
            if left < (lowest if roughness is None else BETTER * lowest):
                lowest, found = left, states()
        restore(found)
        # Under a map for metals what is no metal tells itself apart at once
        sure = float(metal.all())
        metal = find_metal(scene, replace(problem, metal=metal), cfg, sure)
        return Start(lowest, trial(metal, DECIDING), metal, states())

    start = attempt(problem.metal)
    everywhere = attempt(torch.ones_like(problem.metal))
    if all_metal(start, everywhere):
        start = everywhere
    if math.isinf(start.left):
        restore(before)
        return problem
    restore(start.states)
    return replace(problem, metal=start.metal)


def all_metal(start: Start, everywhere: Start) -> bool:
    """Whether what metal everywhere led to is the better start."""
    if everywhere.metal.float().mean() <= 0.5:
        return everywhere.left < CONVINCING * start.left
    # A round may end badly by chance: one good one is enough
    return everywhere.left < MOSTLY * start.left or everywhere.lowest < MOSTLY * start.lowest
