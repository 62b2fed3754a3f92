"""Which points of the surface are metal, by what either material would have to look like.

Descending from one to the other fails: between a base under a dull layer and a coloured mirror lie
materials that look like neither. Under a known light either is one unknown base colour a roughness,
so both are fitted and their residuals compared.
"""

from __future__ import annotations

import torch
from scipy.spatial import KDTree
from torch import Tensor

from univoxel.brdf import F0
from univoxel.color import CLIPPED, linear_to_srgb_unclipped, srgb_slope, srgb_to_linear
from univoxel.config import JointConfig
from univoxel.joint.newton import CAUCHY, MIN_VIEWS
from univoxel.joint.observations import (
    JointProblem,
    observations_of,
    prefiltered_roughness,
    shade_observations,
)
from univoxel.scene import Scene

# Roughnesses that are tried, from a mirror to chalk
ROUGHNESSES = (0.1, 0.2, 0.3, 0.45, 0.65, 0.9)
# Gauss-Newton steps on a base colour
STEPS = 5
# Bounds of a base colour
BASE = (0.005, 1.0)
# Points whose evidence is averaged: that of one alone is too noisy
NEIGHBOURS = 32
# Voxels that count as one unit of distance between points
NEAR = 4.0
# Log albedo that counts as one unit of distance between points
ALIKE = 0.5
# Bound of the log ratio of one point: a single one does not decide for its neighbours
MAX_EVIDENCE = 2.0
# Log ratio of residuals, metal over dielectric, below which a point is metal: under the first map
# and under the last. The first asks for more: the map is wrong yet, and metals make the next one
THRESHOLD = (-0.4, -0.15)


def find_metal(scene: Scene, problem: JointProblem, cfg: JointConfig, done: float) -> Tensor:
    """Which of the problem's points are metal under the present map: [P] bool.

    Args:
        done: progress of the map in [0, 1], from the first round of Newton to the last.
    """
    first, last = THRESHOLD
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
    costs = [residuals(scene, problem, point, observation, cfg, r) for r in ROUGHNESSES]
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
    cfg: JointConfig,
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
    metal = fitted(black, mirror - black, target, cfg.metal.min_reflectance)
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
