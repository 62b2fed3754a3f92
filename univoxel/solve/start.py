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

TRIED = 100  # points of Newton rounds that tell what to suppose
STEPS = 6  # of such a round; after three, from no map, too glossy still looks better than right
ROUGHNESS = (0.25, 0.7)  # medians that are tried beside the present one
BETTER = 0.95  # times the others' residual: what is left if another roughness is to be supposed
CONVINCING = 0.8  # the same of metal everywhere
TRIALS = 2 * (1 + len(ROUGHNESS) + 1)  # rounds of Newton that this takes


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
    few = replace(cfg, newton_points=TRIED, newton_steps=steps, newton_roughness=0.0)
    parts = [part for part in (scene.material, scene.sky, scene.views) if part is not None]
    seed = int(torch.randint(2**31, ()))

    def trial(metal: Tensor) -> float:
        """What is left after a round on points that are the same in all trials."""
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(seed)
            tried = replace(problem, metal=metal)
            costs = newton_round(scene, tried, few, seconds / TRIALS, tell)
        return costs[-1] if costs else math.inf

    def states() -> list[dict]:
        return [copy.deepcopy(part.state_dict()) for part in parts]

    def restore(states: list[dict]) -> None:
        for part, state in zip(parts, states, strict=True):
            part.load_state_dict(state)

    before = states()
    least, best = math.inf, (problem, before)
    suppositions = (problem.metal, 1.0), (torch.ones_like(problem.metal), CONVINCING)
    for metal, share in suppositions:
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
        metal = find_metal(scene, replace(problem, metal=metal), cfg, 0.0)
        left = trial(metal)
        if left < share * least:
            least, best = left, (replace(problem, metal=metal), states())
    restore(best[1])
    return best[0]
