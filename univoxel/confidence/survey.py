"""Points of the surface, and what the photographs fix of each.

No truth is read: only the photographs that were trained on, and the scene.
docs/explanation/trust.md explains the terms.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from scipy.spatial import KDTree
from torch import Tensor

from univoxel import brdf
from univoxel.color import CLIPPED, linear_to_srgb_unclipped
from univoxel.data import Photos
from univoxel.joint.observations import (
    JointProblem,
    prefiltered_roughness,
    shade_observations,
    turned_maps,
    without_exposure,
)
from univoxel.records import Surface
from univoxel.render.pipeline import RAYS_AT_ONCE, at_rays, extract_mesh, shade
from univoxel.render.transport import (
    Observations,
    Transport,
    mean_colors,
    observe,
    surface_points,
    trace,
)
from univoxel.scene import Scene
from univoxel.sphere import fibonacci_sphere

POINTS = 20_000  # of the surface that evaluation surveys, for its maps of doubt
REPORT_POINTS = 2_000  # of the surface that are surveyed after training, for words alone

# Observations of a point that are rendered again, at most
OBSERVATIONS = 8
# Directions that visibility is measured in where the scene has no map with its own
DIRECTIONS = 64
# Roughness over which the slope of the render is taken
ROUGHNESS_STEP = 0.05
# Views straight from above that determine an albedo to a doubt of one half
ENOUGH_VIEWS = 3.0
# sRGB; disagreement with the photographs that means a doubt of one half
NOISE = 0.02
# sRGB; darker pixels are noise
BLACK = 0.02


@dataclass(frozen=True)
class Survey:
    """What is known of P points, evenly spread over the surface; tensors are [P]."""

    position: Tensor  # [P, 3]
    normal: Tensor  # [P, 3]
    voxel_size: float
    views: Tensor  # photographs that see the point, nothing between
    straight: Tensor  # sum over those that are not clipped or black there of their squared cosine
    spread: Tensor  # degrees: arc cosine of the length of the mean of their directions
    clipped: Tensor  # share of them that are clipped there
    black: Tensor  # share of them that are black there
    visibility: Tensor  # share of the light's directions, by cosine, that the object leaves open
    disagreement: Tensor  # mean absolute difference of photographs and render, sRGB
    gloss: Tensor  # root of the sum over the views of (change of sRGB by roughness)^2

    @property
    def albedo(self) -> Tensor:
        """Doubt of the albedo, in [0, 1]: 1 - seen * visibility * agreeing."""
        seen = self.seen_with(self.straight)
        return torch.where(self.views > 0, 1 - seen * self.visibility * self.agreeing, 1.0)

    def seen_with(self, straight: Tensor) -> Tensor:
        """How well points are seen, [..., P] in [0, 1], with such sums of squared cosines."""
        return straight / (straight + ENOUGH_VIEWS)

    @property
    def agreeing(self) -> Tensor:
        """How well render and photographs agree, in (0, 1]."""
        return NOISE / (self.disagreement + NOISE)

    @property
    def roughness(self) -> Tensor:
        """Doubt of the roughness, in [0, 1]: 1 - seen * visibility * agreeing * glossy.

        glossy^2 is the share by which the photographs narrow what is known of roughness, its
        variance, when before it could be anything in [0, 1].
        """
        information = self.information
        return 1 - (1 - self.albedo) * (information / (1 + information)).sqrt()

    @property
    def information(self) -> Tensor:
        """That photographs have of roughness, over that of knowing [0, 1] alone, whose variance is
        1/12: each sRGB value has the noise NOISE."""
        return (self.gloss / NOISE).square() / 12


@torch.no_grad()
def survey(scene: Scene, photos: Photos, points: int) -> Survey:
    """What the photographs that were trained on fix of points of the surface.

    Args:
        points: how many, >= 1, spread evenly.

    Raises:
        ValueError: the scene has no surface.
    """
    generator = torch.Generator().manual_seed(0)
    photos = scene.registered(photos)
    mesh, tracer, offset = extract_mesh(scene), scene.occluder(), scene.field.voxel_size
    position, normal = surface_points(mesh, points, generator)
    observations = observe(position, normal, photos, tracer, offset)
    direction = scene.sky.direction if scene.sky else fibonacci_sphere(DIRECTIONS)
    # What occludes light is as bright as the nearest point is in the photographs
    nearest = KDTree(position.numpy()).query(mesh.vertices.numpy(), workers=-1)[1]
    point_color = mean_colors(without_exposure(scene, observations))
    vertex_color = point_color[torch.from_numpy(nearest)]
    transport = trace(observations, tracer, mesh, vertex_color, direction, 1, offset, generator)

    cosine = (normal @ direction.T).clamp_min(0)
    visibility = (cosine * transport.visibility / 255).sum(1) / cosine.sum(1).clamp_min(1e-6)
    counts = observations.offsets.diff()
    point = torch.repeat_interleave(counts)
    encoded = linear_to_srgb_unclipped(observations.color)
    clipped, black = (encoded > CLIPPED).any(1), (encoded < BLACK).all(1)
    usable = ~(clipped | black)
    straight = (observations.wo * normal[point]).sum(1).square()

    def total(values: Tensor) -> Tensor:
        return torch.zeros(points, *values.shape[1:]).index_add_(0, point, values)

    at_least_one = counts.clamp_min(1)
    mean_length = (total(observations.wo).norm(dim=1) / at_least_one).clamp(0, 1)
    spread = torch.where(counts > 0, mean_length.acos().rad2deg(), 0.0)
    compared = spread_observations(observations, OBSERVATIONS)
    disagreement, gloss = compare(scene, observations, transport, compared, ROUGHNESS_STEP)
    return Survey(
        position=position,
        normal=normal,
        voxel_size=offset,
        views=counts,
        straight=total(straight * usable),
        spread=spread,
        clipped=total(clipped.float()) / at_least_one,
        black=total(black.float()) / at_least_one,
        visibility=visibility,
        disagreement=disagreement,
        gloss=gloss * counts.sqrt(),
    )


def spread_observations(observations: Observations, most: int) -> tuple[Tensor, Tensor]:
    """At most so many observations of each point, spread over all: their points and numbers."""
    counts = observations.offsets.diff()[:, None]
    which = torch.arange(most) * counts.clamp_min(most) // most
    point, _ = (which < counts).nonzero().unbind(1)
    return point, (observations.offsets[:-1, None] + which)[which < counts]


def compare(
    scene: Scene,
    observations: Observations,
    transport: Transport,
    which: tuple[Tensor, Tensor],
    roughness_step: float,
) -> tuple[Tensor, Tensor]:
    """Mean absolute difference in sRGB of photographs and render, and root mean square of the
    render's slope by roughness: [P] each, 0 where there is no observation.

    A clipped pixel says only that it was at least so bright.

    Args:
        which: points and numbers of the observations that are compared.
        roughness_step: that the slope is taken over.
    """
    point, observation = which
    features = scene.field.features_at(observations.position)
    albedo, roughness, metallic = scene.material(features)
    step = torch.where(roughness > 0.5, -roughness_step, roughness_step)
    surface = Surface(
        position=observations.position,
        normal=observations.normal,
        features=features,
        albedo=albedo,
        roughness=roughness,
        opacity=torch.ones_like(roughness),
        depth=torch.ones_like(roughness),
        metallic=metallic,
    )
    changed = replace(surface, roughness=roughness + step)
    present, other = (
        linear_to_srgb_unclipped(render(scene, s, observations, transport, point, observation))
        for s in (surface, changed)
    )
    target = linear_to_srgb_unclipped(observations.color[observation])
    difference = (target - present).abs()
    at_least = (target > CLIPPED) & (present > target)
    difference = torch.where(at_least, 0.0, difference).mean(1)
    slope = ((other - present) / step[point, None]).square()
    slope = torch.where(target > CLIPPED, 0.0, slope).sum(1)
    count = torch.bincount(point, minlength=len(features)).clamp_min(1)
    disagreement, gloss = (
        torch.zeros(len(features)).index_add_(0, point, x) / count for x in (difference, slope)
    )
    return disagreement, gloss.sqrt()


def render(
    scene: Scene,
    surface: Surface,
    observations: Observations,
    transport: Transport,
    point: Tensor,
    observation: Tensor,
) -> Tensor:
    """Radiance [N, 3] of observations [N] of points [N], under the scene's map if it was fitted
    with traced visibility: local lights would explain away what is off."""
    if scene.sky is None:
        parts = []
        for k in torch.arange(len(point)).split(RAYS_AT_ONCE):
            at_points, o = at_rays(surface, point[k]), observation[k]
            view = observations.view[o]
            parts.append(shade(scene, at_points, observations.wo[o], view=view))
        return torch.cat(parts) if parts else torch.zeros(0, 3)
    assert surface.metallic is not None
    diffuse, f0 = brdf.split(surface.albedo, surface.metallic)
    assert isinstance(f0, Tensor)
    color, voxel_size = observations.color, scene.field.voxel_size
    turned = turned_maps(scene, observations)
    problem = JointProblem(observations, transport, color, voxel_size, scene.sky, turned)
    roughness = prefiltered_roughness(surface.roughness, problem.nodes)
    shaded = observations.normal[point], diffuse[point], roughness[point], f0[point]
    return shade_observations(scene, problem, point, observation, *shaded)
