"""Surface points with their observations in photographs, and their shading under one map."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from univoxel.camera import project
from univoxel.color import linear_to_srgb_unclipped, srgb_to_linear
from univoxel.config import JointConfig
from univoxel.core.records import HALF_MAX, Mesh
from univoxel.data import Photos
from univoxel.data.photos import coverage_of
from univoxel.errors import NoSurface
from univoxel.fields.field import MaterialHead
from univoxel.lights.latlong import DistantLight
from univoxel.lights.views import Flash, resampling
from univoxel.ops import VisibilityScene, shade_map
from univoxel.render.pipeline import extract_mesh
from univoxel.scene import Scene

MIN_COSINE = 0.15  # views at a more grazing angle blur over too much surface
MIN_ALPHA = 0.99  # of a photograph where it shows a point and no background
POINTS_AT_ONCE = 4096


@dataclass(frozen=True)
class Observations:
    """Surface points as the photographs see them; S observations, sorted by point."""

    position: Tensor  # [P, 3]
    normal: Tensor  # [P, 3] unit
    offsets: Tensor  # [P + 1] int64: point p has observations offsets[p] .. offsets[p + 1]
    wo: Tensor  # [S, 3] unit, to the camera
    color: Tensor  # [S, 3] linear
    view: Tensor  # [S] int64: which photograph
    eye: Tensor  # [V, 3] where the photographs were taken from

    def away(self, point: Tensor, observation: Tensor) -> Tensor:
        """World units [N] between points [N] and the cameras of observations [N] of them."""
        return (self.eye[self.view[observation]] - self.position[point]).norm(dim=1)

    def at(self, points: Tensor) -> Observations:
        """Those of some points, [N] int64, in their order."""
        counts = self.offsets.diff()[points]
        offsets = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
        within = torch.arange(int(offsets[-1])) - offsets[:-1].repeat_interleave(counts)
        index = self.offsets[points].repeat_interleave(counts) + within
        by_point = (x[index] for x in (self.wo, self.color, self.view))
        return Observations(
            self.position[points], self.normal[points], offsets, *by_point, eye=self.eye
        )


@dataclass(frozen=True)
class Transport:
    """What arrives at surface points from D directions: visibility of the sky, and other light."""

    direction: Tensor  # [D, 3] unit, evenly spread over the sphere
    visibility: Tensor  # [P, D] uint8: share of the direction where the sky is visible, 255 for all
    indirect: Tensor  # [P, D, 3] float16: radiance from the occluded share, times that share


def surface_points(mesh: Mesh, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Points [P, 3] spread evenly over a mesh by area, and their interpolated unit normals."""
    a, b, c = mesh.vertices[mesh.faces.long()].unbind(1)
    area = torch.linalg.cross(b - a, c - a).norm(dim=1).double()
    # Stratified: one point in each equal share of the area
    share = (torch.arange(count) + torch.rand(count, generator=generator)) / count
    face = torch.searchsorted(area.cumsum(0) / area.sum(), share.double()).clamp_max(len(area) - 1)
    u, v = torch.rand(2, count, generator=generator).unbind(0)
    u, v = torch.where(u + v > 1, 1 - u, u), torch.where(u + v > 1, 1 - v, v)
    weight = torch.stack([1 - u - v, u, v], 1)[..., None]
    corner = mesh.faces[face].long()
    assert mesh.normals is not None
    position = (mesh.vertices[corner] * weight).sum(1)
    return position, normalize((mesh.normals[corner] * weight).sum(1), dim=1)


def observe(
    position: Tensor, normal: Tensor, photos: Photos, scene: VisibilityScene, offset: float
) -> Observations:
    """Where the photographs see each point, and its colour there.

    An observation counts where the photograph is opaque, the view not too grazing and nothing on
    the mesh stands between.

    Args:
        offset: world units that rays start above the surface.
    """

    def seen_in(v: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        eye = photos.cameras.camera_to_world[v, :, 3]
        towards = normalize(eye - position, dim=1)
        pixel, depth = project(photos.cameras, v, position)
        size = torch.tensor(photos.cameras.size(v))
        inside = ((pixel > 1) & (pixel < size - 1)).all(1) & (depth > 0)
        facing = (inside & ((normal * towards).sum(1) > MIN_COSINE)).nonzero()[:, 0]
        stored_color, stored_alpha = photos.stored(v)
        picture = stored_color.movedim(-1, 0)[None].float()
        uv = (2 * pixel[facing] / size - 1)[None, None]
        # Interpolate as stored, then decode: what is seen between two pixels is their mean colour
        pixel_color = grid_sample(picture, uv, align_corners=False)[0, :, 0].T
        if photos.color.dtype == torch.uint8:
            pixel_color = srgb_to_linear(pixel_color / 255)
        coverage = coverage_of(stored_alpha)
        alpha = grid_sample(coverage[None, None], uv, align_corners=False)[0, 0, 0]
        start = position[facing] + offset * (normal[facing] + towards[facing])
        reach = (eye - start).norm(dim=1).max().item() if len(facing) else 0.0
        visible = ~scene.occluded(start, towards[facing], 0.0, reach)
        counted = visible & (alpha > MIN_ALPHA)
        of_view = torch.full((int(counted.sum()),), v)
        return facing[counted], towards[facing][counted], pixel_color[counted], of_view

    point, wo, color, view = zip(*map(seen_in, range(len(photos))), strict=True)
    index = torch.cat(point)
    order = torch.argsort(index, stable=True)
    counts = torch.bincount(index, minlength=len(position))
    offsets = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
    by_point = [torch.cat(parts)[order] for parts in (wo, color, view)]
    eyes = photos.cameras.camera_to_world[:, :, 3]
    return Observations(position, normal, offsets, *by_point, eye=eyes)


def mean_colors(observations: Observations) -> Tensor:
    """Mean colour [P, 3] over the photographs that see a point: how bright it is for others.

    Black where none does: such places are deep and dark.
    """
    counts = observations.offsets.diff()
    point = torch.repeat_interleave(counts)
    total = observations.color.new_zeros(len(counts), 3)
    total = total.index_add(0, point, observations.color)
    return total / counts.clamp_min(1)[:, None]


def trace(
    observations: Observations,
    scene: VisibilityScene,
    mesh: Mesh,
    vertex_color: Tensor,
    direction: Tensor,
    rays: int,
    offset: float,
    generator: torch.Generator,
) -> Transport:
    """What reaches every point from all directions above its horizon, by ray tracing.

    Occluded light needs no model: what a ray hits is as bright as the photographs show it.

    Args:
        vertex_color: [V, 3] linear radiance of the mesh's vertices.
        direction: [D, 3] unit, evenly spread over the sphere.
        rays: per direction, jittered within its share of the sphere.
        offset: world units that rays start above the surface.
    """
    count, nodes = len(observations.position), len(direction)
    spread = math.sqrt(4 * math.pi / nodes) / 2  # half the distance of neighbouring directions
    first = mesh.faces[:, 0].long()
    visibility = torch.zeros(count, nodes, dtype=torch.uint8)
    indirect = torch.zeros(count, nodes, 3, dtype=torch.float16)
    parts = [slice(b, min(b + POINTS_AT_ONCE, count)) for b in range(0, count, POINTS_AT_ONCE)]
    for part in parts:
        above = observations.normal[part] @ direction.T > -spread
        point, node = above.nonzero().unbind(1)
        start = observations.position[part] + offset * observations.normal[part]
        start = start[point]
        sky = torch.zeros(len(point))
        radiance = torch.zeros(len(point), 3)
        for _ in range(rays):
            jitter = spread * torch.randn(len(point), 3, generator=generator) / math.sqrt(2)
            hit = scene.closest_hit(start, normalize(direction[node] + jitter, dim=1)).face
            sky += hit < 0
            radiance += torch.where((hit >= 0)[:, None], vertex_color[first[hit.clamp_min(0)]], 0.0)
        visibility[part][point, node] = (255 * sky / rays).round().to(torch.uint8)
        indirect[part][point, node] = (radiance / rays).clamp_max(HALF_MAX).half()
    return Transport(direction, visibility, indirect)


# Points of the surface as the photographs see them, and what one map makes of them.


# Vertices of the mesh whose colour is looked up in the photographs; the others of a larger mesh
# take that of the nearest, for memory. Meshes of the presets have fewer
VERTICES = 300_000
METALLIC_BEFORE = 0.2  # metallic from which on the stages before have taken a point for metal
# Share of the surface that they have to take for metal for more of it to be expected. Of objects
# all of metal they take a third and more, of wood and paint next to nothing
LIKELY = 0.15


TURNS = 64  # positions of a turntable that are told apart: closer than the map's nodes


@dataclass(frozen=True)
class TurnedMaps:
    """How a map that turns with the camera reaches the object: what it is in the world, in B
    positions of the turntable."""

    weights: Tensor  # [B, D, D] from the map's nodes to those directions in the world
    position: Tensor  # [V] int64: which of them a photograph was taken in


@dataclass(frozen=True)
class JointProblem:
    """What the joint solve is given: photographs, geometry, and the map that it solves for."""

    observations: Observations  # S observations of P points
    transport: Transport  # from the D nodes of the map to the points
    target: Tensor  # [S, 3] sRGB-encoded colour of the observations
    voxel_size: float  # world units
    sky: DistantLight  # the scene's own map: the solve changes it
    turned: TurnedMaps | None = None  # None: the light stands still
    flash: Flash | None = None  # the scene's own

    @property
    def nodes(self) -> int:
        """Number D of the map's nodes."""
        return len(self.transport.direction)

    @property
    def solid_angle(self) -> float:
        """Steradians that a node of the map stands for."""
        return 4 * math.pi / self.nodes


@dataclass(frozen=True)
class Mirrors:
    """Points that mirror the map, among all P of the problem."""

    metal: Tensor  # [P] bool
    sharp: Tensor  # [P] bool: of them, those that mirror more sharply than the map's nodes
    normal: Tensor  # [P, 3] unit, without relief where sharp
    base: Tensor  # [P, 3] what they reflect; 0 elsewhere

    def where(self, kept: Tensor) -> Mirrors | None:
        """Those of them that are kept, of [P] bool; None: none are."""
        metal, base = self.metal & kept, torch.where(kept[:, None], self.base, 0.0)
        return Mirrors(metal, self.sharp & kept, self.normal, base) if metal.any() else None


@dataclass(frozen=True)
class MaterialLabels:
    """What the joint optimisation has decided so far; replaced as it continues."""

    metal: Tensor  # [P] bool, which points are metal
    sun: Tensor | None = None  # [D, 3] what a sun adds to the log map, which else is smooth
    albedo: Tensor | None = None  # [P, 3] where the materials do not follow the map yet
    mirrors: Mirrors | None = None  # None: nothing mirrors the map
    only_metal: bool = False  # whether nothing but metal is there
    likely: bool = False  # whether the stages before saw enough metal to expect more


@torch.no_grad()
def build_problem(scene: Scene, photos: Photos, cfg: JointConfig, seed: int) -> JointProblem:
    """The problem of a scene with a map: points of its surface, their observations, and what light
    can reach them. NoSurface if there is none, or no photograph sees it."""
    assert scene.sky is not None  # the configuration has seen to it
    generator = torch.Generator().manual_seed(seed)
    mesh = extract_mesh(scene)
    tracer = scene.occluder()
    offset = scene.field.voxel_size
    vertex_color = vertex_colors(scene, mesh, photos, VERTICES)
    position, normal = surface_points(mesh, cfg.points, generator)
    observations = observe(position, normal, photos, tracer, offset)
    if not len(observations.view):
        raise NoSurface("no surface point is seen in any photograph")
    direction = scene.sky.direction
    transport = trace(
        observations, tracer, mesh, vertex_color, direction, cfg.tracing, offset, generator
    )
    target = linear_to_srgb_unclipped(observations.color)
    turned = turned_maps(scene, observations)
    return JointProblem(observations, transport, target, offset, scene.sky, turned, scene.flash)


def has_one_light(scene: Scene, problem: JointProblem) -> bool:
    """Whether the map lights all photographs alike, and nothing else does."""
    varies = scene.views is not None and scene.views.sky_change() is not None
    return problem.turned is None and problem.flash is None and not varies


def turned_maps(scene: Scene, observations: Observations) -> TurnedMaps | None:
    """The scene's map in the world of each photograph; None if it is the same for all."""
    turntable = scene.cfg.turntable
    if turntable is None or scene.sky is None:
        return None
    turns = turntable.turn(observations.eye, TURNS)
    used, position = turns.flatten(1).unique(dim=0, return_inverse=True)
    return TurnedMaps(resampling(scene.sky.direction, used.view(-1, 3, 3)), position)


@torch.no_grad()
def first_labels(scene: Scene, problem: JointProblem, cfg: JointConfig) -> MaterialLabels:
    """Decisions to start with: metal is what the stages before have made metallic, or all if that
    is known."""
    features = scene.field.features_at(problem.observations.position)
    metal, only_metal = (scene.material(features)[2] > METALLIC_BEFORE, bool(cfg.only_metal))
    likely = bool(metal.float().mean() > LIKELY)
    return MaterialLabels(metal | only_metal, only_metal=only_metal, likely=likely)


@torch.no_grad()
def with_present_normals(scene: Scene, problem: JointProblem) -> JointProblem:
    """The same problem with the normals that the surface has by now; points stay, and what they
    see."""
    observations = problem.observations
    gradient = scene.field.sample(observations.position).gradient
    normal = normalize(gradient, dim=1, eps=1e-6)
    return replace(problem, observations=replace(observations, normal=normal))


def vertex_colors(scene: Scene, mesh: Mesh, photos: Photos, most: int) -> Tensor:
    """Mean colour [V, 3] of a mesh's vertices in the photographs.

    Args:
        most: vertices that are looked up. Of a larger mesh the others take the colour of the
            nearest, for about every other photograph observes each.
    """
    assert mesh.normals is not None
    step = -(-len(mesh.vertices) // most)
    position, normal = mesh.vertices[::step], mesh.normals[::step]
    observations = observe(position, normal, photos, scene.occluder(), scene.field.voxel_size)
    color = mean_colors(without_exposure(scene, observations))
    if step == 1:
        return color
    nearest = KDTree(position.numpy()).query(mesh.vertices.numpy(), workers=-1)[1]
    return color[torch.from_numpy(nearest)]


def without_exposure(scene: Scene, observations: Observations) -> Observations:
    """The same observations as under one exposure, as far as the scene knows the photographs'."""
    exposure = scene.exposed(torch.ones_like(observations.color), observations.view)
    return replace(observations, color=observations.color / exposure)


def sample_observations(problem: JointProblem, points: int, views: int) -> tuple[Tensor, Tensor]:
    """Random points that are seen, and random observations of each: indices [points * views]."""
    counts = problem.observations.offsets.diff()
    usable = (counts > 0).nonzero()[:, 0]
    point = usable[torch.randint(len(usable), (points,))]
    return point.repeat_interleave(views), observations_of(problem, point, views).reshape(-1)


def halves(problem: JointProblem) -> tuple[JointProblem, JointProblem]:
    """The problem with one half of the observations of each point, and with the other half.

    Neighbouring points take the halves the other way around: no photograph is missing from either.
    """
    observations = problem.observations
    counts = observations.offsets.diff()
    even = (torch.repeat_interleave(counts) + observations.view) % 2 == 0
    first, second = (_with_observations(problem, which) for which in (even, ~even))
    return first, second


def _with_observations(problem: JointProblem, kept: Tensor) -> JointProblem:
    """The problem with only some of its observations, [S] bool."""
    all_of = problem.observations
    ends = torch.cat([kept.new_zeros(1, dtype=torch.long), kept.cumsum(0)])
    by_observation = {name: getattr(all_of, name)[kept] for name in ("wo", "color", "view")}
    observations = replace(all_of, offsets=ends[all_of.offsets], **by_observation)
    return replace(problem, observations=observations, target=problem.target[kept])


def observations_of(problem: JointProblem, point: Tensor, views: int) -> Tensor:
    """Random observations [P, views] of points [P], each of which has at least one."""
    offsets = problem.observations.offsets
    which = (torch.rand(len(point), views) * offsets.diff()[point][:, None]).long()
    return offsets[point][:, None] + which


def shade_observations(
    scene: Scene,
    problem: JointProblem,
    point: Tensor,
    observation: Tensor,
    normal: Tensor,
    diffuse: Tensor,
    roughness: Tensor,
    f0: Tensor,
) -> Tensor:
    """Linear radiance [N, 3] of observations [N] of points [N], each in its photograph's light.

    Args:
        normal, diffuse, roughness, f0: of the points, [N, 3], [N, 3], [N] and [N, 3].
    """
    observations, transport, sky = problem.observations, problem.transport, problem.sky
    view = observations.view[observation]
    change = scene.views.sky_change() if scene.views else None
    if problem.turned is not None:
        which, all_maps = problem.turned.position[view], problem.turned.weights @ sky.radiance
    elif change is not None:
        which, all_maps = view, (sky.log_radiance + change).exp()
    else:
        which, all_maps = None, sky.radiance[None]
    maps, order, parts = all_maps.unbind(), None, (slice(None),)
    if which is not None:
        order = torch.argsort(which)
        parts = order.split(torch.bincount(which, minlength=len(maps)).tolist())
    rgb = torch.cat(
        [
            shade_map(
                radiance,
                transport.visibility,
                transport.indirect,
                point[part],
                normal[part],
                observations.wo[observation[part]],
                diffuse[part],
                roughness[part],
                transport.direction,
                problem.solid_angle,
                f0[part],
            )
            for part, radiance in zip(parts, maps, strict=True)
        ]
    )
    if order is not None:
        rgb = rgb[torch.argsort(order)]
    if problem.flash is not None:
        sharp = unfiltered_roughness(roughness, problem.nodes)
        seen = normal, observations.wo[observation], observations.away(point, observation)
        rgb = rgb + problem.flash.reflected(*seen, diffuse, sharp, f0)
    return scene.exposed(rgb, view)


def prefiltered_roughness(roughness: Tensor, nodes: int) -> Tensor:
    """Roughness whose lobe covers the gap between the map's nodes.

    A node stands for 4 pi / D steradians of sky; between point lights a narrow highlight would be
    missed. Its share of sky, as seen in the half vector, has a variance of about 1 / D in GGX's
    alpha^2, and variances add (Kaplanyan and Hill 2016 filter normals so).
    """
    return (roughness**4 + 1 / nodes) ** 0.25


def unfiltered_roughness(filtered: Tensor, nodes: int) -> Tensor:
    """The roughness of which `prefiltered_roughness` made this."""
    return (filtered**4 - 1 / nodes).clamp_min(MaterialHead.min_roughness**4) ** 0.25
