"""Metals that mirror their surroundings, found by how much of what they show the map explains.

A mirror shows the map sharper than its nodes lie apart, through normals that are off by degrees. So
neither material fits, and nothing tells them apart. But where a point shows what lies in the
mirrored direction, some normal near the present one explains most of how its colour changes from
view to view; no normal does so for paint, whose colour changes less, or in another way. What the
sharpest of those points show makes a finer map, and that map finer normals.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import normalize

from univoxel import sphere
from univoxel.color import linear_to_srgb_unclipped
from univoxel.envmap import EnvMap, lookup
from univoxel.joint.config import JointConfig, MirrorConfig
from univoxel.joint.metals import likeness
from univoxel.joint.observations import (
    JointProblem,
    Mirrors,
    observations_of,
    without_exposure,
)
from univoxel.scene import Scene


@dataclass(frozen=True)
class Sightings:
    """What N points of the surface show in V observations each."""

    key: Tensor  # [N, 6] of points, see `likeness`
    normal: Tensor  # [N, 3]
    wo: Tensor  # [N, V, 3]
    color: Tensor  # [N, V, 3] linear
    open: Tensor  # [N, V] bool: the sky is where the mirrored direction points, and around it

    @property
    def encoded(self) -> Tensor:
        """[N, V, 3] sRGB."""
        return linear_to_srgb_unclipped(self.color.clamp(0, 1))

    def mean(self, values: Tensor) -> Tensor:
        """Of values [N, V] over the observations that are open: [N]."""
        return (values * self.open).sum(1) / self.open.sum(1).clamp_min(1)

    def at(self, index: Tensor) -> Sightings:
        return Sightings(**{name: value[index] for name, value in vars(self).items()})


@dataclass(frozen=True)
class TexelMap:
    """What maps of texels [H, 2 H] and of nodes [D] are to one another."""

    weight: Tensor  # [2 H H, D] of the nodes at a texel
    node_at: Tensor  # [H, 2 H] int64 nearest node
    beside: Tensor  # [D, K] int64 nodes next to each, itself among them
    rows: int

    @staticmethod
    def of(direction: Tensor, rows: int, neighbours: int) -> TexelMap:
        texels = sphere.latlong_directions(rows).flatten(0, 1)
        cosine = texels @ direction.T
        weight = torch.softmax(len(direction) / 5.0 * cosine, 1)
        beside = (direction @ direction.T).topk(neighbours + 1, 1).indices
        return TexelMap(weight, cosine.argmax(1).view(rows, 2 * rows), beside, rows)

    def from_nodes(self, nodes: Tensor) -> Tensor:
        """[D, 3] -> [H, 2 H, 3]."""
        return (self.weight @ nodes).view(self.rows, 2 * self.rows, 3)

    def blurred(self, texels: Tensor) -> Tensor:
        """[H, 2 H, 3] as the nodes would hold it."""
        area = sphere.texel_solid_angles(self.rows, 2 * self.rows).reshape(-1, 1)
        weight = self.weight * area
        nodes = weight.T @ texels.flatten(0, 1) / weight.sum(0)[:, None]
        return self.from_nodes(nodes)

    def nearest(self, direction: Tensor) -> Tensor:
        """Node [...] next to directions [..., 3]."""
        u, v = sphere.direction_to_latlong(direction).unbind(-1)
        column = (u * 2 * self.rows).long() % (2 * self.rows)
        return self.node_at[(v * self.rows).long().clamp_max(self.rows - 1), column]


@torch.no_grad()
def find_mirrors(scene: Scene, problem: JointProblem, cfg: JointConfig) -> Mirrors | None:
    """Points that mirror the present map; None: there are none, or light differs between
    photographs, so that no map is common to them.

    What is random is drawn from a generator of its own: where nothing mirrors, nothing changes.
    """
    if problem.turned is not None or (scene.views and scene.views.sky_change() is not None):
        return None
    texels = TexelMap.of(problem.sky.direction, cfg.mirror.rows, cfg.newton.neighbours)
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(0)
        seen = sightings(scene, problem, texels, cfg)
    usable = (seen.open.sum(1) >= cfg.mirror.min_views).nonzero()[:, 0]
    if len(usable) < cfg.mirror.neighbours:
        return None
    contrast = spread(seen.at(usable))
    contrast = contrast[neighbours(seen.key[usable], cfg.mirror.neighbours)].mean(1)
    chosen = usable[contrast > cfg.mirror.contrast]
    if len(chosen) < cfg.mirror.neighbours:
        return None
    found = mirrors_among(seen.at(chosen), problem.sky.radiance, texels, cfg.mirror)
    if not found.metal.any():
        return None
    count = len(seen.key)
    metal, sharp = torch.zeros(2, count, dtype=torch.bool)
    base, normal = torch.zeros(count, 3), seen.normal.clone()
    metal[chosen], sharp[chosen], base[chosen] = found.metal, found.sharp, found.base
    normal[chosen] = found.normal
    # Points that mirror the object, not the sky, are as their neighbours
    nearest = KDTree(seen.key[usable].numpy()).query(seen.key.numpy(), workers=-1)[1]
    like = usable[torch.from_numpy(nearest)]
    return Mirrors(metal[like], sharp[like], normal, base[like])


def sightings(scene: Scene, problem: JointProblem, texels: TexelMap, cfg: JointConfig) -> Sightings:
    """Of all points of the problem; those that no photograph sees have none that are open."""
    observations = without_exposure(scene, problem.observations)
    counts = observations.offsets.diff()
    point = torch.arange(len(counts))
    observation = observations_of(problem, point, cfg.mirror.views)
    observation = observation.clamp_max(len(observations.view) - 1)
    normal, wo = observations.normal, observations.wo[observation]
    mirrored, cosine = reflect(normal, wo)
    visible = problem.transport.visibility == 255
    node = texels.nearest(mirrored)
    is_open = (cosine > cfg.mirror.min_cosine) & (counts > 0)[:, None]
    for beside in texels.beside.unbind(1):
        is_open &= visible.gather(1, beside[node])
    key = likeness(scene, problem, cfg.metal)
    return Sightings(key, normal, wo, observations.color[observation], is_open)


def reflect(normal: Tensor, wo: Tensor) -> tuple[Tensor, Tensor]:
    """Mirrored directions [N, V, 3] of wo [N, V, 3] about normals [N, 3], and cosines [N, V]."""
    cosine = (normal[:, None] * wo).sum(2)
    return 2 * cosine[..., None] * normal[:, None] - wo, cosine


def neighbours(key: Tensor, count: int) -> Tensor:
    """Index [N, K] of the nearest by key [N, 6], at most `count`, itself first."""
    nearest = KDTree(key.numpy()).query(key.numpy(), k=min(count, len(key)), workers=-1)[1]
    return torch.from_numpy(nearest).reshape(len(key), -1)


def spread(seen: Sightings) -> Tensor:
    """Mean deviation [N] of a point's colours from their mean, sRGB."""
    encoded = seen.encoded
    mean = torch.stack([seen.mean(encoded[..., c]) for c in range(3)], 1)
    return seen.mean((encoded - mean[:, None]).abs().mean(2))


def mirrors_among(
    seen: Sightings, radiance: Tensor, texels: TexelMap, cfg: MirrorConfig
) -> Mirrors:
    """Which of N points mirror a map of nodes, radiance [D, 3].

    First by the map itself. From what the points show that do so with most contrast a map of texels
    is made; the points that it explains better than a blurred copy of it are sharp.
    """
    nearest = neighbours(seen.key, cfg.neighbours)
    near = nearest[:, : cfg.smoothing]
    radius, total = math.radians(cfg.radius), spread(seen)[nearest].sum(1).clamp_min(1e-4)
    coarse = linear_to_srgb_unclipped(texels.from_nodes(radiance).clamp(0, 1)).contiguous()

    def turned(map: Tensor, normal: Tensor, radius: float) -> tuple[Tensor, Tensor]:
        cost, best = best_normals(replace(seen, normal=normal), map, radius, cfg)
        offset = (best - normal)[near].median(1).values
        return 1 - cost[nearest].sum(1) / total, normalize(normal + offset, dim=1)

    share, normal = turned(coarse, seen.normal, radius)
    metal = share > cfg.share[0]
    if not metal.any():
        return Mirrors(metal, metal, seen.normal, torch.zeros_like(normal))
    normal = torch.where(metal[:, None], normal, seen.normal)
    base = reflectance(replace(seen, normal=normal), radiance, texels, metal, nearest, cfg)
    contrast = total / base.amax(1) ** (1 / 2.4)
    sharp = metal & (contrast > cfg.sharpest * contrast[metal].quantile(0.9))
    for k in range(cfg.rounds):
        fine = texel_map(replace(seen, normal=normal), base, sharp, coarse, cfg.prior)
        share, finer = turned(fine, normal, radius / 2**k)
        metal = metal | (share > cfg.share[1])
        costs = [
            cost_of(replace(seen, normal=finer), map, cfg)[nearest].sum(1)
            for map in (fine, texels.blurred(fine).contiguous())
        ]
        sharp = metal & (costs[0] < costs[1])
        normal = torch.where(sharp[:, None], finer, normal)
        base = reflectance(replace(seen, normal=normal), radiance, texels, metal, nearest, cfg)
        if not sharp.any():
            break
    normal = torch.where(sharp[:, None], normal, seen.normal)
    return Mirrors(metal, sharp, normal, torch.where(metal[:, None], base, 0.0))


def best_normals(
    seen: Sightings, map: Tensor, radius: float, cfg: MirrorConfig
) -> tuple[Tensor, Tensor]:
    """The normals [N, 3] around those of the points with which they mirror a map best, and their
    costs [N].

    Args:
        map: [H, 2 H, 3] sRGB.
        radius: radians, of the cone that is searched.
    """
    u, v = sphere.frame(seen.normal)
    cost, best = torch.full((len(u),), math.inf), seen.normal.clone()
    grid = torch.linspace(-radius, radius, cfg.steps)
    for a in grid.tolist():
        for b in grid.tolist():
            if math.hypot(a, b) > 1.01 * radius:
                continue
            normal = normalize(seen.normal + a * u + b * v, dim=1)
            present = cost_of(replace(seen, normal=normal), map, cfg)
            better = present < cost
            cost, best = (
                torch.where(better, present, cost),
                torch.where(better[:, None], normal, best),
            )
    return cost, best


def cost_of(seen: Sightings, map: Tensor, cfg: MirrorConfig) -> Tensor:
    """Mean deviation [N] of what points show from a map [H, 2 H, 3] that they mirror, both in sRGB,
    with the best colour of each. A metal has to reflect what metals do."""
    mirrored = lookup(EnvMap(map), reflect(seen.normal, seen.wo)[0])
    shown, weight = seen.encoded, seen.open[..., None]
    factor = (weight * shown * mirrored).sum(1)
    factor = factor / (weight * mirrored.square()).sum(1).clamp_min(1e-4)
    factor = bounded(factor, cfg.min_reflectance ** (1 / 2.4))
    residual = (shown - factor[:, None] * mirrored).abs().mean(2)
    return seen.mean(residual.clamp_max(cfg.max_residual))


def bounded(factor: Tensor, brightest: float) -> Tensor:
    """Factors [N, 3] of at most 1, their largest channel at least as bright as that."""
    factor = factor.clamp(1e-3, 1.0)
    return (factor * (brightest / factor.amax(1, keepdim=True)).clamp_min(1.0)).clamp_max(1.0)


def reflectance(
    seen: Sightings,
    radiance: Tensor,
    texels: TexelMap,
    metal: Tensor,
    nearest: Tensor,
    cfg: MirrorConfig,
) -> Tensor:
    """Base colour [N, 3]: what metals and their neighbours show over what they mirror.

    Only in the darker half of the directions: near a lamp either is clipped, and the map blurred.
    """
    mirrored, cosine = reflect(seen.normal, seen.wo)
    node = texels.nearest(mirrored)
    brightest = radiance.amax(1)[texels.beside].amax(1)[node]
    counted = seen.open & (cosine > 0.5) & metal[:, None]
    if counted.any():
        counted &= brightest <= brightest[counted].median()
    shown = (counted[..., None] * seen.color).sum(1)[nearest].sum(1)
    sent = (counted[..., None] * radiance[node]).sum(1)[nearest].sum(1)
    return bounded(shown / sent.clamp_min(1e-3), cfg.min_reflectance)


def texel_map(seen: Sightings, base: Tensor, sharp: Tensor, coarse: Tensor, prior: float) -> Tensor:
    """The map [H, 2 H, 3], sRGB, that sharp points show; where they show none, the coarse one.

    Args:
        prior: sightings that the coarse map counts for.
    """
    rows = len(coarse)
    counted = seen.open & sharp[:, None]
    value = (seen.encoded / base[:, None] ** (1 / 2.4))[counted].clamp_max(1.0)
    uv = sphere.direction_to_latlong(reflect(seen.normal, seen.wo)[0][counted])
    x, y = uv[:, 0] * 2 * rows - 0.5, (uv[:, 1] * rows - 0.5).clamp(0, rows - 1)
    left, top = x.floor(), y.floor()
    total, weight = prior * coarse.flatten(0, 1), torch.full((2 * rows * rows, 1), prior)
    for right in (0, 1):
        for below in (0, 1):
            share = (1 - (x - left - right).abs()) * (1 - (y - top - below).abs())
            row = (top.long() + below).clamp_max(rows - 1)
            texel = row * 2 * rows + (left.long() + right) % (2 * rows)
            total = total.index_add(0, texel, share[:, None] * value)
            weight = weight.index_add(0, texel, share[:, None])
    return (total / weight).view_as(coarse)
