"""The map as sharply as mirrors show it.

The nodes of the joint solve lie 9 degrees apart. What a polished surface shows is as sharp as the
photographs are, and is the map itself, if normals are known to a few degrees. Where they are off,
points contradict one another: so map and normals are found in turns.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, normalize, pad

from univoxel import sphere
from univoxel.brdf import schlick_f
from univoxel.color import CLIPPED, linear_to_srgb_unclipped, srgb_to_linear
from univoxel.envmap import EnvMap, lookup
from univoxel.lights.latlong import DistantLight, finer

# Degrees by which normals of sharp points are turned at most, search by search
TURNS = (6.0, 3.0)


COARSEST = 4  # rows of the coarsest of the levels that fill each other, at least
LEAST = 0.5  # sightings that a texel has to have before its own count more than those around
SEARCHED = 64  # rows of the map that normals are searched under
CANDIDATES = 5  # normals along each side of the square that is searched
STIFFNESS = 0.03  # sRGB: what a turn by the most degrees has to gain
UNLIKE = 0.3  # sRGB: what is further off is something else, however far
# Of a coarse map over a sharp one: a Gaussian of 17 degrees in which they are compared, the share
# of it that mirrors have to show, the share of lamps in it at most, and which quantile it is
COMPARED_SHARPNESS, SHOWN, LAMPS, LOWEST = 12.0, 0.8, 0.01, 0.1
PLACES = 512  # at which they are compared
ENERGY_ROUNDS, BALANCED = 40, 32  # and rows of the map that light is summed on
MOST_FACTOR = 2.0  # by which all texels may be made brighter or darker in the end


@dataclass(frozen=True)
class MirrorViews:
    """What photographs show of N points that mirror the map sharply."""

    point: Tensor  # [S] int64
    wo: Tensor  # [S, 3] unit
    incident: Tensor  # [S, 3] sRGB-encoded radiance that the point would have to mirror
    clipped: Tensor  # [S] bool: at least so bright

    @staticmethod
    def of(point: Tensor, wo: Tensor, color: Tensor, base: Tensor, normal: Tensor) -> MirrorViews:
        """
        Args:
            color: [S, 3] linear.
            base, normal: of the points, [N, 3] each.
        """
        cosine = (normal[point] * wo).sum(1, keepdim=True).clamp(0, 1)
        reflected = schlick_f(cosine, base[point])
        clipped = (linear_to_srgb_unclipped(color) > CLIPPED).any(1)
        incident = linear_to_srgb_unclipped(color / reflected.clamp_min(1e-3))
        return MirrorViews(point, wo, incident, clipped)

    def at(self, index: Tensor) -> MirrorViews:
        return MirrorViews(**{name: value[index] for name, value in vars(self).items()})

    def mirrored(self, normal: Tensor) -> Tensor:
        """Directions [S, 3] that normals [N, 3] mirror to the eye."""
        normal = normal[self.point]
        return normalize(2 * (normal * self.wo).sum(1, keepdim=True) * normal - self.wo, dim=1)


@dataclass(frozen=True)
class SharpMap:
    """Texels of a map, as mirrors show them."""

    encoded: Tensor  # [R, 2 R, 3] sRGB
    count: Tensor  # [R, 2 R] sightings
    clipped: Tensor  # [R, 2 R] share of them that were clipped


def errors(encoded: Tensor, views: MirrorViews, normal: Tensor) -> Tensor:
    """How far off [S] the views are of a map [R, 2 R, 3] under normals [N, 3]: sRGB, mean over the
    channels, at most UNLIKE."""
    found = lookup(EnvMap(encoded), views.mirrored(normal))
    return (found - views.incident).abs().mean(1).clamp_max(UNLIKE)


def sharp_map(views: MirrorViews, normal: Tensor, rows: int) -> SharpMap:
    """The map that agrees best with what is seen under normals [N, 3].

    Texels that few mirror take what is around them.
    """
    values = torch.cat([views.incident, views.clipped[:, None].float()], 1)
    sums = splat(views.mirrored(normal), pad(values, (0, 1), value=1.0), rows)
    levels = [sums]
    while len(levels[-1]) % 2 == 0 and len(levels[-1]) > COARSEST:
        levels.append(pooled(levels[-1], 2))
    around = values.mean(0)
    for level in reversed(levels):
        filled = (level[..., :4] + LEAST * around) / (level[..., 4:] + LEAST)
        around = finer(filled, 2)
    return SharpMap(filled[..., :3].contiguous(), sums[..., 4], filled[..., 3])


def splat(direction: Tensor, values: Tensor, rows: int) -> Tensor:
    """Sums [rows, 2 rows, C] of values [S, C], each shared among the four texels around its
    direction [S, 3]."""
    u, v = sphere.direction_to_latlong(direction).unbind(1)
    x, y = 2 * rows * u - 0.5, (rows * v - 0.5).clamp(0, rows - 1)
    column, row = x.floor().long(), y.floor().long()
    right, below = x - column, y - row
    sums = values.new_zeros(rows * 2 * rows, values.shape[1])
    for dx, share_x in ((0, 1 - right), (1, right)):
        for dy, share_y in ((0, 1 - below), (1, below)):
            texel = (row + dy).clamp_max(rows - 1) * 2 * rows + (column + dx) % (2 * rows)
            sums.index_add_(0, texel, values * (share_x * share_y)[:, None])
    return sums.view(rows, 2 * rows, -1)


def pooled(map: Tensor, factor: int) -> Tensor:
    """Sums [R / factor, 2 R / factor, C] of a map's texels."""
    return factor**2 * avg_pool2d(map.movedim(2, 0), factor).movedim(0, 2)


def turned_normals(
    views: MirrorViews, encoded: Tensor, normal: Tensor, nearest: Tensor, degrees: float
) -> Tensor:
    """Normals [N, 3] turned by up to so many degrees to where a map [R, 2 R, 3] explains what is
    seen.

    The turn of each is the mean of those around: polished surfaces have no relief.

    Args:
        nearest: [N, K] int64, neighbours of each point, itself among them.
    """
    count = torch.bincount(views.point, minlength=len(normal)).float()
    reach = math.radians(degrees)
    steps = torch.linspace(-reach, reach, CANDIDATES)
    turns = torch.cartesian_prod(steps, steps)
    tangent, bitangent = sphere.frame(normal)
    best = torch.full((len(normal),), math.inf)
    turn = torch.zeros_like(normal)
    for x, y in turns.tolist():
        change = x * tangent + y * bitangent
        error = errors(encoded, views, normalize(normal + change, dim=1))
        cost = torch.zeros(len(normal)).index_add(0, views.point, error)
        cost += STIFFNESS * count * (x * x + y * y) / reach**2
        better = cost < best
        best = torch.where(better, cost, best)
        turn = torch.where(better[:, None], change, turn)
    return normalize(normal + turn[nearest].mean(1), dim=1)


def agreed_normals(views: MirrorViews, normal: Tensor, nearest: Tensor) -> Tensor:
    """Normals [N, 3] under which all views show one map, found with it in turns.

    Args:
        normal: to start from.
        nearest: as of `turned_normals`.
    """
    for degrees in TURNS:
        encoded = sharp_map(views, normal, SEARCHED).encoded
        normal = turned_normals(views, encoded, normal, nearest, degrees)
    return normal


def with_energy(map: SharpMap, sky: DistantLight) -> Tensor:
    """Radiance [R, 2 R, 3], linear, of a map that sends the light that a coarser one does.

    Lamps were clipped: what is missing of the light around is theirs. Where nothing was mirrored,
    the coarse map stays.
    """
    rows = len(map.encoded)
    fold = rows // BALANCED
    area = sphere.texel_solid_angles(rows, 2 * rows)[..., None]
    coarse = sky.latlong(rows).detach()
    count = finer(pooled(map.count[..., None], fold), fold) / fold**2
    known = count / (count + LEAST)
    lamp = (known > 0.5) & (map.clipped > 0.5)[..., None]
    fine = srgb_to_linear(map.encoded)

    def light(values: Tensor) -> Tensor:
        return pooled(values * area, fold).flatten(0, 1)

    place = sphere.latlong_directions(BALANCED).flatten(0, 1)
    unit = unit_of(place, *(light(x) for x in (coarse, fine, known, lamp)))
    least = fine = known * unit * fine + (1 - known) * coarse
    receiver = (sky.direction @ place.T).clamp_min(0)  # [D, T] cosines
    sent = receiver / receiver.sum(0)
    wanted = receiver @ light(coarse)

    def missing() -> Tensor:
        factor = sent.T @ (wanted / (receiver @ light(fine)).clamp_min(1e-6))
        return finer(factor.view(BALANCED, 2 * BALANCED, 3), fold)

    for _ in range(ENERGY_ROUNDS):
        fine = torch.maximum(least, torch.where(lamp, fine * missing(), fine))
    return fine * missing().clamp(1 / MOST_FACTOR, MOST_FACTOR)


def unit_of(
    direction: Tensor, coarse: Tensor, fine: Tensor, known: Tensor, lamp: Tensor
) -> Tensor | float:
    """What the sharp map is multiplied by to be in the unit of the coarse one: [3].

    Photographs fix the product of light and albedo, so that a coarse map may call for mirrors that
    send on more than they get. The coarse map spreads what lamps send, so that places far from them
    are least too bright in it.

    Args:
        direction: [T, 3] unit.
        coarse, fine: [T, 3] light from there: radiance times solid angle.
        known, lamp: [T, 1] solid angle that mirrors show, and that is lamp.
    """
    place = sphere.fibonacci_sphere(PLACES)
    near = torch.exp(COMPARED_SHARPNESS * (place @ direction.T - 1))
    whole = 2 * math.pi / COMPARED_SHARPNESS  # steradians, of the Gaussian
    told = ((near @ known > SHOWN * whole) & (near @ lamp < LAMPS * whole))[:, 0]
    if not told.any():
        return 1.0
    ratio = (near[told] @ coarse) / (near[told] @ fine).clamp_min(1e-6)
    return ratio.quantile(LOWEST, 0)
