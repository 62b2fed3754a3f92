"""Points of the surface as the photographs see them, and what one map makes of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import normalize

from univoxel.color import linear_to_srgb_unclipped
from univoxel.config import JointConfig
from univoxel.data import Photos
from univoxel.errors import NoSurface
from univoxel.lights.nodes import DistantLight
from univoxel.lights.turntable import resampling
from univoxel.ops import shade_map
from univoxel.records import Mesh
from univoxel.render.pipeline import extract_mesh
from univoxel.render.transport import (
    Observations,
    Transport,
    mean_colors,
    observe,
    surface_points,
    trace,
)
from univoxel.scene import Scene

# Vertices of the mesh whose colour is looked up in the photographs; the others of a larger mesh
# take that of the nearest, for memory. Meshes of the presets have fewer
VERTICES = 300_000
# Metallic from which on the stages before have taken a point for metal
METALLIC_BEFORE = 0.2


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


@dataclass(frozen=True)
class Decisions:
    """What the joint solve has decided so far; replaced as it goes on."""

    metal: Tensor  # [P] bool, which points are metal
    sun: Tensor | None = None  # [D, 3] what a sun adds to the log map, which else is smooth
    albedo: Tensor | None = None  # [P, 3] where the materials do not follow the map yet
    mirrors: Mirrors | None = None  # None: nothing mirrors the map
    only_metal: bool = False  # whether nothing but metal is there


@torch.no_grad()
def build_problem(scene: Scene, photos: Photos, cfg: JointConfig, seed: int) -> JointProblem:
    """The problem of a scene with a map: points of its surface, their observations, and what light
    can reach them.

    Raises:
        NoSurface: there is no surface, or no photograph sees it.
    """
    assert scene.sky is not None  # the configuration has seen to it
    generator = torch.Generator().manual_seed(seed)
    mesh = extract_mesh(scene)
    tracer = scene.occluder()
    offset = scene.field.voxel_size
    vertex_color = vertex_colors(scene, mesh, photos, VERTICES)
    position, normal = surface_points(mesh, cfg.points, generator)
    observations = observe(position, normal, photos, tracer, offset)
    if not len(observations.view):
        raise NoSurface("no photograph sees a point of the surface")
    direction = scene.sky.direction
    transport = trace(
        observations, tracer, mesh, vertex_color, direction, cfg.tracing, offset, generator
    )
    target = linear_to_srgb_unclipped(observations.color)
    turned = turned_maps(scene, observations)
    return JointProblem(observations, transport, target, offset, scene.sky, turned)


def turned_maps(scene: Scene, observations: Observations) -> TurnedMaps | None:
    """The scene's map in the world of each photograph; None where it is the same for all."""
    turntable = scene.cfg.turntable
    if turntable is None or scene.sky is None:
        return None
    cosine, sine = turntable.turn(observations.eye)
    step = 2 * math.pi / TURNS
    rounded = (torch.atan2(sine, cosine) / step).round().long() % TURNS
    used, position = rounded.unique(return_inverse=True)
    turn = (used * step).cos(), (used * step).sin()
    return TurnedMaps(resampling(scene.sky.direction, turntable, turn), position)


@torch.no_grad()
def first_decisions(scene: Scene, problem: JointProblem, cfg: JointConfig) -> Decisions:
    """Decisions to start with: metal is what the stages before have made metallic, or all if that
    is known."""
    features = scene.field.features_at(problem.observations.position)
    metal, only_metal = (
        scene.material(features)[2] > METALLIC_BEFORE,
        bool(cfg.only_metal),
    )
    return Decisions(metal | only_metal, only_metal=only_metal)


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
    return scene.exposed(rgb, view)


def prefiltered_roughness(roughness: Tensor, nodes: int) -> Tensor:
    """Roughness whose lobe covers the gap between the map's nodes.

    A node stands for 4 pi / D steradians of sky; between point lights a narrow highlight would be
    missed. Its share of sky, as seen in the half vector, has a variance of about 1 / D in GGX's
    alpha^2, and variances add (Kaplanyan and Hill 2016 filter normals so).
    """
    return (roughness**4 + 1 / nodes) ** 0.25
