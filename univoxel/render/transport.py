"""Light transport over the recovered surface: points, what sees them, what they see."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from univoxel.camera import project
from univoxel.color import srgb_to_linear
from univoxel.data import Photos
from univoxel.data.base import coverage_of
from univoxel.ops import VisibilityScene
from univoxel.records import HALF_MAX, Mesh

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
