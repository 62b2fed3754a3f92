"""Detection of metals that reflect their surroundings sharply, by changes between views."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import normalize

from univoxel import sphere
from univoxel.color import linear_to_srgb_unclipped
from univoxel.envmap import EnvMap, lookup
from univoxel.render.observations import (
    JointProblem,
    Mirrors,
    has_one_light,
    observations_of,
    without_exposure,
)
from univoxel.scene import Scene
from univoxel.training.metals import MIN_REFLECTANCE, NEAR
from univoxel.training.newton import NODE_NEIGHBOURS

# Metals that mirror their surroundings, found by how much they change from view to view.
#
# A mirror shows the map sharper than its nodes lie apart, and through normals that are off by many
# degrees. So neither material fits, and residuals do not tell them apart. But how much a point
# changes from view to view does not depend on where exactly it mirrors: of metal it is about as
# much as the map changes between the reflected directions, of paint a part of that.


# Observations of a point that are compared
VIEWS = 16
# Of them, that mirror the sky, at least; other points are as their neighbours
MIN_OPEN_VIEWS = 3
# Cosine between normal and eye of an observation, at least
MIN_COSINE = 0.2
# Points whose changes, colours and normals are averaged
NEIGHBOURS = 32
# Points, most of which decide for each among them
VOTERS = 96
# Difference of unit normals that counts as one unit of distance between points
TURN = 0.5
# Change of metal from view to view, linear, at least: mean deviation from the mean
CHANGE = 0.05
# Part of the change of what it mirrors. Metals of the scenes reach 0.6 to 1, glossy paint 0.1 to
# 0.45
REFLECTED = 0.55
# The same at most: nothing mirrors more than it gets. Metals reach 1.15, whose normals are off;
# under a sun, which leaves the rest of the map dark, paint reaches 1.5 to 15
REFLECTED_AT_MOST = 1.25
# Part of the change that the map leaves unexplained where metal mirrors sharply
SHARP = 0.6
# Log ratio of residuals, see `metals.evidence`, from which a point is paint however much it
# changes. Around the highlight of a sun on paint it was 0.8, of mirrors -0.2 and rarely above
PAINT = 0.25
# Degrees around a direction, whose brightest node tells how dark it is
AROUND = 27.0
# Share of the directions, the darkest, that base colours are read from
DARKEST = 0.25
# Length of the mean of neighbouring normals, above which a surface is not thin
FLAT = 0.7
# Cosine between normals above which they are averaged
ALIKE = 0.3


ROWS = 64  # of the map that is looked up: finer than the nodes lie apart


@dataclass(frozen=True)
class MirrorObservations:
    """What N points of the surface show in V observations each."""

    key: Tensor  # [N, 6] position and normal, in units that count as one distance
    normal: Tensor  # [N, 3]
    wo: Tensor  # [N, V, 3]
    color: Tensor  # [N, V, 3] linear
    open: Tensor  # [N, V] bool: the sky is where the reflected direction points, and around it

    @property
    def encoded(self) -> Tensor:
        """[N, V, 3] sRGB."""
        return linear_to_srgb_unclipped(self.color.clamp(0, 1))

    def mean(self, values: Tensor) -> Tensor:
        """Of values [N, V] over the observations that are open: [N]."""
        return (values * self.open).sum(1) / self.open.sum(1).clamp_min(1)

    def at(self, index: Tensor) -> MirrorObservations:
        return MirrorObservations(**{name: value[index] for name, value in vars(self).items()})


@dataclass(frozen=True)
class NodeMap:
    """A map of nodes, at texels where it is looked up quickly."""

    direction: Tensor  # [D, 3] unit, of the nodes
    radiance: Tensor  # [D, 3]
    node_at: Tensor  # [ROWS, 2 ROWS] int64 nearest node
    encoded: Tensor  # [ROWS, 2 ROWS, 3] sRGB

    @staticmethod
    def of(direction: Tensor, incident: Tensor, radiance: Tensor) -> NodeMap:
        """
        Args:
            incident: [ROWS, 2 ROWS, 3] what the nodes are at the texels.
        """
        node_at = (sphere.latlong_directions(ROWS) @ direction.T).argmax(2)
        encoded = linear_to_srgb_unclipped(incident.clamp(0, 1)).contiguous()
        return NodeMap(direction, radiance, node_at, encoded)

    def nearest(self, direction: Tensor) -> Tensor:
        """Node [...] next to directions [..., 3]."""
        u, v = sphere.direction_to_latlong(direction).unbind(-1)
        column = (u * 2 * ROWS).long() % (2 * ROWS)
        return self.node_at[(v * ROWS).long().clamp_max(ROWS - 1), column]

    def brightest_within(self, degrees: float) -> Tensor:
        """Brightest channel [D] of the nodes around each."""
        near = self.direction @ self.direction.T > math.cos(math.radians(degrees))
        return torch.where(near, self.radiance.amax(1), 0.0).amax(1)


@torch.no_grad()
def find_mirrors(scene: Scene, problem: JointProblem) -> Mirrors | None:
    """Points that mirror the present map; None: there are none, or light differs between
    photographs, so that no map is common to them.

    What is random comes from a generator of its own: where nothing mirrors, nothing changes.
    """
    if not has_one_light(scene, problem):
        return None
    sky, count = problem.sky, NEIGHBOURS
    map = NodeMap.of(sky.direction, sky.latlong(ROWS), sky.radiance)
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(0)
        seen = mirror_observations(scene, problem, map)
    decided = (seen.open.sum(1) >= MIN_OPEN_VIEWS).nonzero()[:, 0]
    if len(decided) < count:
        return None
    found = mirrors_among(seen.at(decided), map)
    voters_count = min(VOTERS, len(seen.key))
    if 2 * found.metal.sum() <= voters_count:  # no point can have a majority
        return None
    # Points that mirror the object, not the sky, are as their neighbours
    nearest = KDTree(seen.key[decided].numpy()).query(seen.key.numpy(), workers=-1)[1]
    like = torch.from_numpy(nearest)[neighbours(seen.key, voters_count)]
    voters = found.metal[like][..., None].float()
    base = (voters * found.base[like]).sum(1) / voters.sum(1).clamp_min(1)
    metal, sharp = (x[like].float().mean(1) > 0.5 for x in (found.metal, found.sharp))
    if not metal.any():
        return None
    sharp, normal = smoothed(problem.observations.position, seen.normal, sharp & metal)
    return Mirrors(metal, sharp, normal, torch.where(metal[:, None], base, 0.0))


def sees_sky(problem: JointProblem, map: NodeMap, point: Tensor, direction: Tensor) -> Tensor:
    """Whether the sky is where points [N] look [N, ..., 3], and around it: [N, ...] bool."""
    visible, node = problem.transport.visibility == 255, map.nearest(direction)
    row = point.view(-1, *[1] * (node.dim() - 1))
    cosine = map.direction @ map.direction.T
    near = cosine.topk(NODE_NEIGHBOURS + 1, 1).indices.unbind(1)  # the node itself among them
    return torch.stack([visible[row, beside[node]] for beside in near]).all(0)


def mirror_observations(scene: Scene, problem: JointProblem, map: NodeMap) -> MirrorObservations:
    """Of all points of the problem; those that no photograph sees have none that are open."""
    observations = without_exposure(scene, problem.observations)
    counts = observations.offsets.diff()
    observation = observations_of(problem, torch.arange(len(counts)), VIEWS)
    observation = observation.clamp_max(len(observations.view) - 1)
    normal, wo = observations.normal, observations.wo[observation]
    mirrored, cosine = reflect(normal, wo)
    is_open = (cosine > MIN_COSINE) & (counts > 0)[:, None]
    is_open &= sees_sky(problem, map, torch.arange(len(counts)), mirrored)
    unit = NEAR * problem.voxel_size
    key = torch.cat([observations.position / unit, normal / TURN], 1)
    return MirrorObservations(key, normal, wo, observations.color[observation], is_open)


def reflect(normal: Tensor, wo: Tensor) -> tuple[Tensor, Tensor]:
    """Mirrored directions [N, V, 3] of wo [N, V, 3] about normals [N, 3], and cosines [N, V]."""
    cosine = (normal[:, None] * wo).sum(2)
    return 2 * cosine[..., None] * normal[:, None] - wo, cosine


def neighbours(key: Tensor, count: int) -> Tensor:
    """Index [N, count] of the nearest by key [N, K], itself first."""
    nearest = KDTree(key.numpy()).query(key.numpy(), k=count, workers=-1)[1]
    return torch.from_numpy(nearest).reshape(len(key), -1)


def mirrors_among(seen: MirrorObservations, map: NodeMap) -> Mirrors:
    """Which of N points change from view to view as much as what they mirror.

    Metal that the map explains with the present normals is rough: it blurs what is wrong with them.
    """
    nearest = neighbours(seen.key, NEIGHBOURS)
    node = map.nearest(reflect(seen.normal, seen.wo)[0])
    shown, sent = (
        change(seen, radiance.clamp(0, 1))[nearest].sum(1)
        for radiance in (seen.color, map.radiance[node])
    )
    enough = shown > CHANGE * nearest.shape[1]
    metal = enough & (shown > REFLECTED * sent) & (shown < REFLECTED_AT_MOST * sent)
    unexplained = unexplained_change(seen, map)[nearest].sum(1)
    total = change(seen, seen.encoded)[nearest].sum(1)
    sharp = metal & (unexplained > SHARP * total)
    base = reflectance(seen, map, metal, sharp, nearest)
    return Mirrors(metal, sharp, seen.normal, base)


def change(seen: MirrorObservations, color: Tensor) -> Tensor:
    """Mean deviation [N] of colours [N, V, 3] from the mean of their point."""
    mean = torch.stack([seen.mean(color[..., c]) for c in range(3)], 1)
    return seen.mean((color - mean[:, None]).abs().mean(2))


def unexplained_change(seen: MirrorObservations, map: NodeMap) -> Tensor:
    """Mean deviation [N] of what points show from the map that they mirror, sRGB, with the best
    colour of each."""
    mirrored = lookup(EnvMap(map.encoded), reflect(seen.normal, seen.wo)[0])
    shown, weight = seen.encoded, seen.open[..., None]
    factor = (weight * shown * mirrored).sum(1)
    factor = factor / (weight * mirrored.square()).sum(1).clamp_min(1e-4)
    return seen.mean((shown - factor[:, None] * mirrored).abs().mean(2))


def reflectance(
    seen: MirrorObservations, map: NodeMap, metal: Tensor, sharp: Tensor, nearest: Tensor
) -> Tensor:
    """Base colour [N, 3] of metals: what they and their neighbours show over what they mirror; 0
    elsewhere. How bright sharp ones are is that of their whole region, as polish is of one metal.

    Only of directions where all around is dark. Near a lamp the photographs are clipped and the map
    is blurred, and normals that are off mistake the lamp for what is beside it. Parts of a mirror
    see none that is dark.
    """
    mirrored, cosine = reflect(seen.normal, seen.wo)
    node = map.nearest(mirrored)
    around = map.brightest_within(AROUND)[node]
    counted = seen.open & (cosine > 0.5) & metal[:, None]
    if counted.any():
        counted &= around <= around[counted].quantile(DARKEST)
    shown, sent = (
        (counted[..., None] * color).sum(1) for color in (seen.color, map.radiance[node])
    )
    near = ratio(shown[nearest].sum(1), sent[nearest].sum(1))
    region, regions = regions_of(sharp, nearest)
    shown, sent = (
        x.new_zeros(regions, 3).index_add(0, region, x * sharp[:, None])[region]
        for x in (shown, sent)
    )
    bright = ratio(shown, sent).amax(1, keepdim=True)
    base = torch.where(sharp[:, None], near * bright / near.amax(1, keepdim=True), near)
    return torch.where(metal[:, None], base, 0.0)


def ratio(shown: Tensor, sent: Tensor) -> Tensor:
    """Base colours [N, 3] that send on as much of what is sent [N, 3] as is shown [N, 3]: at
    most 1, the largest channel at least as bright as metals are."""
    factor = (shown / sent.clamp_min(1e-3)).clamp(1e-3, 1.0)
    brighter = (MIN_REFLECTANCE / factor.amax(1, keepdim=True)).clamp_min(1.0)
    return (factor * brighter).clamp_max(1.0)


def regions_of(inside: Tensor, nearest: Tensor) -> tuple[Tensor, int]:
    """The connected parts of those inside [N] bool, by neighbours [N, K]: index [N] of each point's
    part, and how many there are; every other point is a part of its own."""
    point = torch.arange(len(inside)).repeat_interleave(nearest.shape[1])
    other = nearest.flatten()
    linked = inside[point] & inside[other]
    count = len(inside)
    links = coo_array(
        (linked[linked].numpy(), (point[linked].numpy(), other[linked].numpy())), (count, count)
    )
    regions, region = connected_components(links, directed=False)
    return torch.from_numpy(region).long(), regions


def smoothed(position: Tensor, normal: Tensor, sharp: Tensor) -> tuple[Tensor, Tensor]:
    """Which of the sharp points [P] stay sharp, and normals [P, 3], those of sharp points averaged
    over their neighbours.

    What is mirrored looks like relief while geometry forms; polished surfaces have none. Thin ones
    stay, whose normals differ among neighbours. These are off by more than the map's nodes lie
    apart, so that what the map leaves unexplained does not tell how sharply they mirror.
    """
    index = sharp.nonzero()[:, 0]
    if len(index) < NEIGHBOURS:
        return sharp, normal
    own = normal[index]
    around = own[neighbours(position[index], NEIGHBOURS)]
    flat = around.mean(1).norm(dim=1, keepdim=True) > FLAT
    weight = ((own[:, None] * around).sum(2, keepdim=True) - ALIKE).clamp_min(0)
    mean = normalize((weight * around).sum(1), dim=1)
    return (
        sharp.index_copy(0, index, flat[:, 0]),
        normal.index_copy(0, index, torch.where(flat, mean, own)),
    )
