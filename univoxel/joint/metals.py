"""Which points of the surface are metal, by what either material would have to look like.

Descending from one to the other fails: between a base under a dull layer and a coloured mirror lie
materials that look like neither. Under a known light either is one unknown base colour a roughness,
so both are fitted and their residuals compared.
"""

from __future__ import annotations

import torch
from scipy.spatial import KDTree
from torch import Tensor

from univoxel import losses
from univoxel.brdf import F0
from univoxel.color import CLIPPED, srgb_to_linear
from univoxel.joint.config import JointConfig
from univoxel.joint.equations import CAUCHY, encoded_slope
from univoxel.joint.observations import LEAST_VIEWS, Problem, draw_sightings, sightings_of, widened
from univoxel.scene import Scene

ROUGHNESS = (0.1, 0.2, 0.3, 0.45, 0.65, 0.9)  # that are tried
STEPS = 5  # of Gauss-Newton on a base colour
BASE = 0.005, 1.0  # its bounds
METAL_BASE = 0.25  # the brightest channel of a metal; those in use reflect 0.4 and more
NEIGHBOURS = 32  # points whose evidence is averaged: one alone is too noisy
NEAR, ALIKE = 4.0, 0.5  # voxels, and units of log albedo, that count alike as distance
BOUND = 2.0  # of one point's log ratio
# Log ratio of residuals, metal over dielectric, from which on it is metal: under the first map and
# under the last. While the map is wrong, so is much that it says; and metals make the next map
ASKED = -0.4, -0.15


def find_metal(scene: Scene, problem: Problem, cfg: JointConfig, done: float) -> Tensor:
    """Decide under the present map which of the problem's points are metal: [P] bool.

    Args:
        done: progress of the map in [0, 1], from the first round of Newton to the last.
    """
    return evidence(scene, problem, cfg) < ASKED[0] + done * (ASKED[1] - ASKED[0])


@torch.no_grad()
def evidence(scene: Scene, problem: Problem, cfg: JointConfig) -> Tensor:
    """Log ratio of what is left of the photographs if a point is metal, over if it is not: [P].

    `cfg.newton_points` of them, in `cfg.newton_views` sightings, are fitted as dielectrics and as
    metals, with the best roughness for each; the log ratio of the two residuals is averaged over
    points that are near and of like albedo, and the others follow the nearest of them. A metal has
    to reflect what metals do: black plastic would pass for a metal that is black.
    """
    seen = problem.seen
    counts = seen.offsets.diff()
    rich = (counts >= LEAST_VIEWS).nonzero()[:, 0]
    if not len(rich):
        return torch.zeros(len(counts))
    chosen = rich[torch.randperm(len(rich))[: cfg.newton_points]]
    sighting = sightings_of(problem, chosen, cfg.newton_views)
    tried = [residuals(scene, problem, chosen, sighting, r) for r in ROUGHNESS]
    dielectric, metal = torch.stack(tried).amin(0)
    ratio = (metal / dielectric).log().clamp(-BOUND, BOUND)

    albedo = scene.material(scene.field.features_at(seen.position))[0].clamp_min(1e-2).log()
    key = torch.cat([seen.position / (NEAR * problem.voxel_size), albedo / ALIKE], 1).numpy()
    some = key[chosen.numpy()]  # a tensor of one index would be taken for a number
    tree = KDTree(some)
    near = tree.query(some, k=min(NEIGHBOURS, len(chosen)), workers=-1)[1]
    mean = ratio[torch.from_numpy(near).reshape(len(chosen), -1)].mean(1)
    return mean[torch.from_numpy(tree.query(key, workers=-1)[1])]


def residuals(
    scene: Scene, problem: Problem, point: Tensor, sighting: Tensor, roughness: float
) -> Tensor:
    """Robust costs [2, P] of points [P] in sightings [P, V], as the best dielectric and as the best
    metal of a roughness."""
    count, views = sighting.shape
    index, flat = point.repeat_interleave(views), sighting.flatten()
    normal = problem.seen.normal[index]
    rough = widened(torch.full((len(flat),), roughness), len(problem.transport.direction))

    def drawn(diffuse: float, f0: float) -> Tensor:
        color = torch.ones(len(flat), 3)
        args = scene, problem, index, flat, normal, diffuse * color, rough, f0 * color
        return draw_sightings(*args).view(count, views, 3)

    target = problem.target[sighting]
    black, white = drawn(0.0, 0.0), drawn(0.0, 1.0)  # linear in F0
    layer = black + F0 * (white - black)
    dielectric = fitted(layer, drawn(1.0, F0) - layer, target, 0.0)
    return torch.stack([dielectric, fitted(black, white - black, target, METAL_BASE)])


def fitted(constant: Tensor, slope: Tensor, target: Tensor, least: float) -> Tensor:
    """Cauchy costs [P] of constant + base * slope [P, V, 3], at the best base colours, against the
    sRGB-encoded target [P, V, 3].

    Args:
        least: of a base's brightest channel.
    """

    def possible(base: Tensor) -> Tensor:
        base = base.clamp(*BASE)
        return base * (least / base.amax(1, keepdim=True)).clamp_min(1.0)

    def look() -> tuple[Tensor, Tensor, Tensor]:  # residual, its square in units of CAUCHY, slope
        shown = constant + base[:, None] * slope
        residual = target - losses.encode(shown)
        free = (target <= CLIPPED) | (residual > 0)  # clipped pixels are lower bounds
        return free * residual, (free * residual / CAUCHY).square(), encoded_slope(shown) * slope

    base = (srgb_to_linear(target) - constant).sum(1) / slope.sum(1).clamp_min(1e-6)
    base = possible(base)
    for _ in range(STEPS):
        residual, square, by_base = look()
        weighted = by_base / (1 + square)
        step = (weighted * residual).sum(1) / (weighted * by_base).sum(1).clamp_min(1e-6)
        base = possible(base + step)
    return CAUCHY**2 * torch.log1p(look()[1]).mean((1, 2)) + 1e-6
