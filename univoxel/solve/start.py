"""Where the joint solve starts from: roughness and metal under no map yet, by trial."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from univoxel.config import JointConfig
from univoxel.scene import Scene
from univoxel.solve.metals import find_metal
from univoxel.solve.newton import newton_round
from univoxel.solve.sightings import Problem

TRIED = 100  # points of Newton rounds that tell what roughness to suppose
DECIDING = 3  # times as many, of the two that tell whether all is metal
STEPS = 6  # of such a round; after three, from no map, too glossy still looks better than right
ROUGHNESS = (0.25, 0.7)  # medians that are tried beside the present one
BETTER = 0.95  # times the others' residual: what is left if another roughness is to be supposed
# The same of metal everywhere, and where most is then found to be metal. In the stress suite that
# is so of objects all of metal alone: 0.67 to 0.93 of them is, of dielectrics up to 0.24
CONVINCING, MOSTLY = 0.8, 0.95
TRIALS = 2 * (1 + len(ROUGHNESS) + DECIDING)  # rounds of Newton of so many points that this takes


def supposed(
    scene: Scene, problem: Problem, cfg: JointConfig, seconds: float, tell: Callable[[str], None]
) -> Problem:
    """The problem with its metals, and the scene's map and roughness, from the best supposition.

    Light and material are found from one another: under a roughness that is wrong everywhere the
    map becomes too sharp or too dull for any other, and where all is metal, a map for dielectrics
    is so bright that nothing looks like metal under it. So rounds of Newton start from what the
    stages before took for metal and from metal everywhere, each with the roughness of the stages
    before and with some others, as a whole; metals are found under the best map of either, and the
    residual of a round with them decides.

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
    least, best = math.inf, (problem, before)
    for metal in (problem.metal, torch.ones_like(problem.metal)):
        everywhere = bool(metal.all())
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
        sure = 1.0 if everywhere else 0.0
        metal = find_metal(scene, replace(problem, metal=metal), cfg, sure)
        left = trial(metal, DECIDING)
        mostly = MOSTLY if metal.float().mean() > 0.5 else CONVINCING
        if left < (mostly if everywhere else 1.0) * least:
            least, best = left, (replace(problem, metal=metal), states())
    restore(best[1])
    return best[0]
