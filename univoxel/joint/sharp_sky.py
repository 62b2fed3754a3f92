"""The scene's map as sharply as its mirrors show it."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from univoxel.config import JointConfig
from univoxel.data import Photos
from univoxel.joint.mirrored_map import (
    agreed_normals,
    errors,
    sharp_map,
    with_energy,
)
from univoxel.joint.mirrors import NEIGHBOURS, ROWS, NodeMap, neighbours, open_views
from univoxel.joint.observations import JointProblem, Mirrors
from univoxel.render.transport import Observations, observe
from univoxel.scene import Scene

POINTS = 8000  # that are looked at, at least: closer together than those of the joint solve
FORETOLD = 0.8  # of the error of one colour, at most
PROJECTIONS = 2  # steps that bring them to the surface


@torch.no_grad()
def sharpen_sky_(
    scene: Scene, photos: Photos, problem: JointProblem, mirrors: Mirrors, cfg: JointConfig
) -> bool:
    """Give the scene the map that its mirrors show; whether they show one.

    They do if what half of the photographs show tells the other half better than the nodes do, and
    much better than one colour.
    """
    parent = mirrors.sharp.nonzero()[:, 0]
    if not cfg.mirror.rows or len(parent) < NEIGHBOURS:
        return False
    parent = parent.repeat(-(-POINTS // len(parent)))
    observations = points_beside(scene, photos, problem, parent)
    sky = problem.sky
    nodes = NodeMap.of(sky.direction, sky.latlong(ROWS), sky.radiance)
    base = mirrors.base[parent]
    views, index = open_views(scene, problem, observations, parent, base, nodes)
    first = observations.view[index] % 2 == 0
    if not first.any() or first.all():  # too few to foretell others from
        return False
    nearest = neighbours(observations.position, NEIGHBOURS)
    normal = agreed_normals(views, observations.normal, nearest)
    seen, told = views.at(first), views.at(~first)
    half = sharp_map(seen, normal, ROWS).encoded
    of_nodes, of_half = (errors(map, told, normal).mean() for map in (nodes.encoded, half))
    of_mean = (told.incident - seen.incident.mean(0)).abs().mean()
    if not of_half < min(of_nodes, FORETOLD * of_mean):
        return False
    scene.sharpen_sky(with_energy(sharp_map(views, normal, cfg.mirror.rows), sky))
    return True


def points_beside(
    scene: Scene, photos: Photos, problem: JointProblem, parent: Tensor
) -> Observations:
    """What photographs see of points of the surface, each a voxel or two beside such a one [N] of
    the problem."""
    generator = torch.Generator().manual_seed(0)
    beside = torch.randn(len(parent), 3, generator=generator) * problem.voxel_size
    position = problem.observations.position[parent] + beside
    for _ in range(PROJECTIONS):
        sample = scene.field.sample(position)
        normal = normalize(sample.gradient, dim=1, eps=1e-6)
        position = position - sample.sdf[:, None] * normal
    normal = normalize(scene.field.sample(position).gradient, dim=1, eps=1e-6)
    return observe(position, normal, photos, scene.occluder(), problem.voxel_size)
