"""What the photographs fix of a scene's materials, and what they leave open: maps and words.

No truth is read: only the photographs that were trained on, and the scene.
docs/explanation/trust.md explains the terms.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from univoxel import brdf, losses
from univoxel.color import CLIPPED
from univoxel.data import Photos
from univoxel.joint.observations import Problem, draw_sightings, unexposed, widened
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

POINTS, FEW_POINTS = 20000, 2000  # on the surface: for maps, and for words alone
SIGHTINGS = 8  # of a point that are rendered again, at most
DIRECTIONS = 64  # that openness is measured in where the scene has no map with its own
STEP = 0.05  # of roughness, in the difference that tells what it changes
ENOUGH = 3.0  # views straight from above that determine an albedo to a doubt of one half
NOISE = 0.02  # sRGB; disagreement with the photographs that means a doubt of one half
BLACK = 0.02  # sRGB; darker pixels are noise
NORMALS = 3.0  # voxels that opposite sides of a thin part lie farther apart, over 2
NEIGHBOURS = 4  # points that a pixel takes its doubt from

# Of what is told in words: views, degrees, share of the light, difference in sRGB
FEW, ONE_SIDE, SHUT, OFF = 3, 15.0, 0.5, 0.05


@dataclass(frozen=True)
class Survey:
    """What is known of P points, evenly spread over the surface; everything is [P]."""

    position: Tensor  # [P, 3]
    normal: Tensor  # [P, 3]
    voxel_size: float
    views: Tensor  # photographs that see the point, nothing between
    straight: Tensor  # sum over those that are not clipped or black there of their squared cosine
    spread: Tensor  # degrees: arc cosine of the length of the mean of their directions
    clipped: Tensor  # share of them that are clipped there
    black: Tensor  # share of them that are black there
    open: Tensor  # share of the light's directions, by cosine, that nothing of the object blocks
    disagreement: Tensor  # mean absolute difference of photographs and render, sRGB
    gloss: Tensor  # root of the sum over the views of (change of sRGB by roughness)^2

    @property
    def albedo(self) -> Tensor:
        """Doubt of the albedo, in [0, 1]: 1 - seen * open * agreeing."""
        seen = self.straight / (self.straight + ENOUGH)
        agreeing = NOISE / (self.disagreement + NOISE)
        return torch.where(self.views > 0, 1 - seen * self.open * agreeing, 1.0)

    @property
    def roughness(self) -> Tensor:
        """Doubt of the roughness, in [0, 1]: 1 - seen * open * agreeing * glossy.

        glossy^2 is the share by which the photographs narrow what is known of roughness, its
        variance, when before it could be anything in [0, 1] and each sRGB value has the noise NOISE
        """
        information = (self.gloss / NOISE).square() / 12
        return 1 - (1 - self.albedo) * (information / (1 + information)).sqrt()


@torch.no_grad()
def survey(scene: Scene, photos: Photos, points: int = POINTS) -> Survey:
    """Look at points of the surface from the photographs that were trained on.

    Raises:
        ValueError: the scene has no surface.
    """
    generator = torch.Generator().manual_seed(0)
    photos = scene.registered(photos)
    mesh, tracer, offset = extract_mesh(scene), scene.occluder(), scene.field.voxel_size
    position, normal = surface_points(mesh, points, generator)
    seen = observe(position, normal, photos, tracer, offset)
    direction = scene.sky.direction if scene.sky else fibonacci_sphere(DIRECTIONS)
    # What blocks light is as bright as the nearest point is in the photographs
    near = KDTree(position.numpy()).query(mesh.vertices.numpy(), workers=-1)[1]
    bright = mean_colors(unexposed(scene, seen))[torch.from_numpy(near)]
    transport = trace(seen, tracer, mesh, bright, direction, 1, offset, generator)

    cosine = (normal @ direction.T).clamp_min(0)
    free = (cosine * transport.open / 255).sum(1) / cosine.sum(1).clamp_min(1e-6)
    counts = seen.offsets.diff()
    point = torch.repeat_interleave(counts)
    encoded = losses.encode(seen.color)
    clipped, black = (encoded > CLIPPED).any(1), (encoded < BLACK).all(1)
    usable = ~(clipped | black)
    straight = (seen.wo * normal[point]).sum(1).square()

    def total(values: Tensor) -> Tensor:
        return torch.zeros(points, *values.shape[1:]).index_add_(0, point, values)

    each = counts.clamp_min(1)
    together = (total(seen.wo).norm(dim=1) / each).clamp(0, 1)
    spread = torch.where(counts > 0, together.acos().rad2deg(), 0.0)
    disagreement, gloss = compare(scene, seen, transport, some(seen, SIGHTINGS))
    return Survey(
        position=position,
        normal=normal,
        voxel_size=offset,
        views=counts,
        straight=total(straight * usable),
        spread=spread,
        clipped=total(clipped.float()) / each,
        black=total(black.float()) / each,
        open=free,
        disagreement=disagreement,
        gloss=gloss * counts.sqrt(),
    )


def some(seen: Observations, most: int) -> tuple[Tensor, Tensor]:
    """At most so many sightings of each point, spread over all: their points and numbers."""
    counts = seen.offsets.diff()[:, None]
    which = torch.arange(most) * counts.clamp_min(most) // most
    point, _ = (which < counts).nonzero().unbind(1)
    return point, (seen.offsets[:-1, None] + which)[which < counts]


def compare(
    scene: Scene, seen: Observations, transport: Transport, which: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """Render sightings again: what is off, and what roughness would change, [P] each.

    A clipped pixel says only that it was at least so bright. Returns the mean absolute difference
    in sRGB, and the root mean square of its slope by roughness; 0 where there is no sighting.
    """
    point, sighting = which
    features = scene.field.features_at(seen.position)
    albedo, roughness, metallic = scene.material(features)
    step = torch.where(roughness > 0.5, -STEP, STEP)
    surface = Surface(
        position=seen.position,
        normal=seen.normal,
        features=features,
        albedo=albedo,
        roughness=roughness,
        opacity=torch.ones_like(roughness),
        depth=torch.ones_like(roughness),
        metallic=metallic,
    )
    changed = replace(surface, roughness=roughness + step)
    shown, other = (
        losses.encode(render(scene, s, seen, transport, point, sighting))
        for s in (surface, changed)
    )
    target = losses.encode(seen.color[sighting])
    off = (target - shown).abs()
    off = torch.where((target > CLIPPED) & (shown > target), 0.0, off).mean(1)
    slope = ((other - shown) / step[point, None]).square()
    slope = torch.where(target > CLIPPED, 0.0, slope).sum(1)
    count = torch.bincount(point, minlength=len(features)).clamp_min(1)
    mean = (torch.zeros(len(features)).index_add_(0, point, x) / count for x in (off, slope))
    off, slope = mean
    return off, slope.sqrt()


def render(
    scene: Scene,
    surface: Surface,
    seen: Observations,
    transport: Transport,
    point: Tensor,
    sighting: Tensor,
) -> Tensor:
    """Radiance [N, 3] of sightings [N] of points [N], under the scene's map if it was fitted with
    traced visibility: local lights would explain away what is off."""
    if scene.sky is None:
        parts = []
        for k in torch.arange(len(point)).split(RAYS_AT_ONCE):
            met, s = at_rays(surface, point[k]), sighting[k]
            parts.append(shade(scene, met, seen.wo[s], view=seen.view[s]))
        return torch.cat(parts) if parts else torch.zeros(0, 3)
    assert surface.metallic is not None
    diffuse, f0 = brdf.split(surface.albedo, surface.metallic)
    assert isinstance(f0, Tensor)
    roughness = widened(surface.roughness, len(transport.direction))
    no_metal = torch.zeros(len(surface.albedo), dtype=torch.bool)
    problem = Problem(seen, transport, seen.color, no_metal, scene.field.voxel_size)
    shown = seen.normal[point], diffuse[point], roughness[point], f0[point]
    return draw_sightings(scene, problem, point, sighting, *shown)


class Doubts:
    """Doubts of a survey, to be looked up anywhere on the surface."""

    def __init__(self, found: Survey):
        self._scale = NORMALS * found.voxel_size
        self._values = torch.stack([found.albedo, found.roughness], 1)
        self._tree = KDTree(self._key(found.position, found.normal))

    def at(self, position: Tensor, normal: Tensor) -> Tensor:
        """Doubt of albedo and of roughness [N, 2] at points [N, 3] with normals [N, 3]: the mean
        of the nearest points, weighted by the inverse squared distance."""
        count = min(NEIGHBOURS, len(self._values))
        found = self._tree.query(self._key(position, normal), k=count, workers=-1)
        away, index = (torch.from_numpy(x.reshape(-1, count)) for x in map(np.asarray, found))
        weight = 1 / (away.square() + 1e-12)
        weight = (weight / weight.sum(1, keepdim=True)).float()
        return (self._values[index] * weight[..., None]).sum(1)

    def _key(self, position: Tensor, normal: Tensor) -> np.ndarray:
        return torch.cat([position, self._scale * normal], 1).numpy()


def numbers(found: Survey) -> dict[str, float]:
    """The survey in figures: means over the surface, shares of it in [0, 1]."""

    def share(where: Tensor) -> float:
        return where.float().mean().item()

    there = found.views > 0
    return {
        "doubt_albedo": found.albedo.mean().item(),
        "doubt_roughness": found.roughness.mean().item(),
        "unseen": share(~there),
        "few_views": share(found.views < FEW),
        "one_side": share(there & (found.spread < ONE_SIDE)),
        "clipped": share(found.clipped > 0.5),
        "black": share(found.black > 0.5),
        "shut": share(found.open < SHUT),
        "disagreeing": share(found.disagreement > OFF),
        "dull": share((found.gloss / NOISE).square() / 12 < 1),
    }


def words(figures: dict[str, float], troubles: list[str]) -> str:
    """The figures as a paragraph, without what is not the case.

    Args:
        troubles: what went wrong in training, from its state.
    """
    said = [
        f"Doubt of albedo {figures['doubt_albedo']:.2f}, of roughness "
        f"{figures['doubt_roughness']:.2f} in the mean over the surface (0: well determined, 1: a "
        "guess)."
    ]
    of_surface = {
        "few_views": f"is seen by fewer than {FEW} cameras: its materials are a guess",
        "one_side": f"is seen from about one direction, within {ONE_SIDE:g} degrees of it: colour "
        "and highlight are hard to tell apart there",
        "clipped": "is clipped in most photographs: shorter exposures would help",
        "black": "is black in most photographs: more light would help",
        "shut": "gets less than half of its light from outside: what parts of the object send to "
        "each other may be left in its albedo",
        "disagreeing": f"differs from its photographs by more than {OFF:g} in sRGB: its surface, "
        "material or light is wrong",
        "dull": "shows no highlight that tells its roughness",
    }
    for name, what in of_surface.items():
        if figures[name] >= 0.01:
            said.append(f"{figures[name]:.0%} of the surface {what}.")
    said.append(
        "Albedo and light share a factor that photographs cannot fix: compare albedos with one "
        "another, not with a colour chart."
    )
    if troubles:
        said.append(f"Training met trouble {len(troubles)} times, the last in {troubles[-1]}.")
    return " ".join(said)
