"""Points of the surface as the photographs see them, and what one map makes of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import normalize

from univoxel import losses
from univoxel.data import Photos
from univoxel.joint.config import JointConfig
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

VERTICES = 300_000  # of a mesh that are looked at; the presets' have fewer
METAL = 0.2  # metallic from which on the stages before have taken a point for metal
LEAST_VIEWS = 2  # of a point that is to tell anything: in one, its colour explains everything


@dataclass(frozen=True)
class Problem:
    """Everything about the photographs and the geometry, which stay fixed, and what is metal."""

    seen: Observations
    transport: Transport
    target: Tensor  # [S, 3] sRGB-encoded sightings
    metal: Tensor  # [P] bool, what is taken for metal; no other point can become it
    voxel_size: float
    sun: Tensor | None = None  # [D, 3] what a sun adds to the log map, which else is smooth
    albedo: Tensor | None = None  # [P, 3] where the materials do not follow the map yet

    @property
    def solid_angle(self) -> float:
        return 4 * math.pi / len(self.transport.direction)


@torch.no_grad()
def pose(scene: Scene, photos: Photos, cfg: JointConfig, seed: int) -> Problem:
    """Sample the surface, gather its sightings and trace what light can reach it.

    Raises:
        ValueError: there is no surface, or no photograph sees it.
    """
    generator = torch.Generator().manual_seed(seed)
    mesh = extract_mesh(scene)
    assert mesh.normals is not None
    assert scene.sky is not None
    tracer = scene.occluder()
    offset = scene.field.voxel_size
    bright = vertex_colors(scene, mesh, photos)
    position, normal = surface_points(mesh, cfg.points, generator)
    seen = observe(position, normal, photos, tracer, offset)
    if not len(seen.view):
        raise ValueError("no photograph sees a point of the surface")
    direction = scene.sky.direction
    transport = trace(seen, tracer, mesh, bright, direction, cfg.tracing, offset, generator)
    metal = scene.material(scene.field.features_at(position))[2] > METAL
    return Problem(seen, transport, losses.encode(seen.color), metal, offset)


@torch.no_grad()
def turned(scene: Scene, problem: Problem) -> Problem:
    """The same with the normals that the surface has by now; points stay, and what they see."""
    gradient = scene.field.sample(problem.seen.position).gradient
    normal = normalize(gradient, dim=1, eps=1e-6)
    return replace(problem, seen=replace(problem.seen, normal=normal))


def vertex_colors(scene: Scene, mesh: Mesh, photos: Photos) -> Tensor:
    """Mean colour [P, 3] of a mesh's vertices in the photographs; of a large mesh that of the
    nearest of some, for each has a sighting in every other photograph."""
    assert mesh.normals is not None
    step = -(-len(mesh.vertices) // VERTICES)
    some, normal = mesh.vertices[::step], mesh.normals[::step]
    seen = observe(some, normal, photos, scene.occluder(), scene.field.voxel_size)
    color = mean_colors(unexposed(scene, seen))
    if step == 1:
        return color
    near = KDTree(some.numpy()).query(mesh.vertices.numpy(), workers=-1)[1]
    return color[torch.from_numpy(near)]


def unexposed(scene: Scene, seen: Observations) -> Observations:
    """The same as one exposure would have it, as far as the scene knows the photographs'."""
    return replace(seen, color=seen.color / scene.exposed(torch.ones_like(seen.color), seen.view))


def draw(problem: Problem, points: int, views: int) -> tuple[Tensor, Tensor]:
    """Random points that are seen, and random sightings of each: indices [points * views]."""
    counts = problem.seen.offsets.diff()
    usable = (counts > 0).nonzero()[:, 0]
    point = usable[torch.randint(len(usable), (points,))]
    return point.repeat_interleave(views), sightings_of(problem, point, views).reshape(-1)


def sightings_of(problem: Problem, point: Tensor, views: int) -> Tensor:
    """Random sightings [P, views] of points [P], each of which has some."""
    offsets = problem.seen.offsets
    which = (torch.rand(len(point), views) * offsets.diff()[point][:, None]).long()
    return offsets[point][:, None] + which


def draw_sightings(
    scene: Scene,
    problem: Problem,
    point: Tensor,
    sighting: Tensor,
    normal: Tensor,
    diffuse: Tensor,
    roughness: Tensor,
    f0: Tensor,
) -> Tensor:
    """What the map makes of sightings [N] of points [N], each in its photograph's light: [N, 3].

    Args:
        normal, diffuse, roughness, f0: of the points, [N, 3], [N, 3], [N] and [N, 3].
    """
    seen, transport, sky = problem.seen, problem.transport, scene.sky
    assert sky is not None
    view = seen.view[sighting]
    change = scene.views.sky_change() if scene.views else None
    if change is None:
        order, parts, maps = None, (slice(None),), [sky.radiance]
    else:  # a map for each view
        order = torch.argsort(view)
        parts = order.split(torch.bincount(view, minlength=len(change)).tolist())
        maps = (sky.log_radiance + change).exp().unbind()
    rgb = torch.cat(
        [
            shade_map(
                map,
                transport.open,
                transport.indirect,
                point[part],
                normal[part],
                seen.wo[sighting[part]],
                diffuse[part],
                roughness[part],
                transport.direction,
                problem.solid_angle,
                f0[part],
            )
            for part, map in zip(parts, maps, strict=True)
        ]
    )
    if order is not None:
        rgb = rgb[torch.argsort(order)]
    return scene.exposed(rgb, view)


def widened(roughness: Tensor, nodes: int) -> Tensor:
    """Roughness whose lobe covers the gap between the map's nodes.

    A node stands for 4 pi / D steradians of sky; between point lights a narrow highlight would be
    missed. Its share of sky, as seen in the half vector, has a variance of about 1 / D in GGX's
    alpha^2, and variances add (Kaplanyan and Hill 2016 filter normals so).
    """
    return (roughness**4 + 1 / nodes) ** 0.25
