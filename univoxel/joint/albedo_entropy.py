"""What the few colours of a surface say of the light.

A diffuse point under one light shows its albedo times its irradiance and nothing of either: under a
map that is brighter above than it was, or that lacks a sun, shades and shadows become paint. But
paint comes in few colours. Under the right light all that is painted alike has one albedo, in the
shade and outside of it; under a wrong one each colour is smeared over as many as there are kinds of
shade. So the map is brought to where the entropy of the albedos is least, in what the photographs
tell least: a sun, and slow changes over the sphere.

Source: entropy as in Finlayson, Drew and Lu 2004, "Intrinsic images by entropy minimization"; the
few colours of a scene as in Gehler et al. 2011, "Recovering intrinsic images with a global sparsity
prior on reflectance"; the hash is that of Teschner et al. 2003.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from univoxel import brdf
from univoxel.joint.observations import Problem, draw_sightings, sightings_of, unexposed, widened
from univoxel.render.transport import mean_colors
from univoxel.scene import Scene
from univoxel.sphere import real_harmonics

POINTS, FEWEST = 3000, 300  # that are looked at
SIGHTINGS = 3  # that each has at least
DARKEST = 2e-3  # linear; less is noise of 8 bits
DARK = 1e-6  # light on a point that nothing seems to reach
PAINTED = 0.5  # least share of them that is no metal: a few may be metal that was not recognised
CELL = 0.15  # of log albedo, whose colours count as one
TABLE = 2**14  # entries for the occupied cells, by hash
PRIMES = (73856093, 19349663, 83492791)

SHARES = (0.35, 0.5, 0.65, 0.8, 0.9, 0.95)  # of the surface's light, tried for every direction
# Nats that a sun has to save of the entropy. Suns of half of the light or more save 0.12 to 0.3; of
# 46 trainings of the stress suite without one, one found a sun, in grainy photographs
CLEARER = 0.08
AT_ONCE = 64  # suns
PHOTOGRAPHS = 2  # of each point that tell its albedo, once the light is known
LOWEST, HIGHEST = 0.01, 0.95  # albedo of what is matte: coal and snow
LEAST_REACH = 0.02  # mean cosine that counts for a node that hardly reaches any of the surface

ORDER = 2  # of the harmonics that change the log map
STEPS = (0.5, 0.25, 0.12, 0.06)  # by which each is changed, both ways ...
SWEEPS = 2  # ... so many times each ...
WORTH = 0.005  # ... where that saves so many nats: 15 for all of the points


@dataclass(frozen=True)
class Shown:
    """Points [P] of the surface that show their paint."""

    point: Tensor  # [P] int64
    color: Tensor  # [P, 3] mean over the photographs
    reach: Tensor  # [P, D] what the map's nodes send to them, for albedo 1
    between: Tensor  # [P, 3] what comes from the surface itself

    def lit(self, radiance: Tensor) -> Tensor:
        """What reaches the points under a map [D, 3]: [P, 3], above 0."""
        return (self.reach @ radiance + self.between).clamp_min(DARK)

    def entropy(self, light: Tensor) -> Tensor:
        """Of the albedos, if light [P, K, 3] reaches the points: [K]."""
        return palette_entropy((self.color[:, None] / light.clamp_min(DARK)).log())


def shown(scene: Scene, problem: Problem) -> Shown | None:
    """Some points that are no metal, not dark and seen often; None: there are too few, or most are
    metal, or each photograph has a light of its own, which tells more."""
    if scene.views is not None and scene.views.sky_change() is not None:
        return None
    seen = unexposed(scene, problem.seen)
    color = mean_colors(seen)
    usable = (seen.offsets.diff() >= SIGHTINGS) & (color.amin(1) > DARKEST)
    point = (usable & ~problem.metal).nonzero()[:, 0]
    if len(point) < max(FEWEST, PAINTED * int(usable.sum())):
        return None
    point = point[torch.randperm(len(point))[:POINTS]]
    return Shown(point, color[point], *_reaching(problem, point))


@torch.no_grad()
def sunlit(scene: Scene, problem: Problem, say: Callable[[str], None]) -> Problem:
    """The problem and the scene's map with a sun, if one leaves the points fewer colours.

    Compared are the map as it is, an even sky, and an even sky with a sun, for every direction of
    the map and some shares. With a sun the map becomes that sky and sun.

    Args:
        say: called with a sentence where there is one.
    """
    sky, points = scene.sky, shown(scene, problem)
    assert sky is not None
    if points is None:
        return problem
    lit = points.lit(sky.radiance)
    mean, between = lit.mean(0), points.between
    even = (mean - between.mean(0)).clamp_min(0.1 * mean) / points.reach.sum(1).mean()
    overcast = points.reach.sum(1, keepdim=True) * even + between
    least = LEAST_REACH * problem.solid_angle / math.pi
    power = mean / points.reach.mean(0).clamp_min(least)[:, None]  # [D, 3] for all of the light
    without = points.entropy(torch.stack([lit, overcast], 1)).min()
    left = torch.zeros(len(SHARES), len(power))
    for some in torch.arange(len(power)).split(AT_ONCE):
        suns = points.reach[:, some, None] * power[some]
        for k, share in enumerate(SHARES):
            left[k, some] = points.entropy((1 - share) * overcast[:, None] + share * suns)
    if left.min() > without - CLEARER:
        return problem
    best, node = divmod(int(left.argmin()), len(power))
    radiance = ((1 - SHARES[best]) * even).repeat(len(power), 1)
    sun = torch.zeros_like(radiance)
    sun[node] = (1 + SHARES[best] * power[node] / radiance[node]).log()
    sky.log_radiance.copy_(radiance.log() + sun)
    x, y, z = sky.direction[node].tolist()
    azimuth, elevation = math.degrees(math.atan2(y, x)), math.degrees(math.asin(z))
    say(
        f"a sun sends {SHARES[best]:.0%} of the light, from about azimuth {azimuth:.0f}, "
        f"elevation {elevation:.0f} degrees"
    )
    return replace(problem, sun=sun)


@torch.no_grad()
def balance(scene: Scene, problem: Problem) -> bool:
    """Change the scene's map slowly over the sphere, and a sun's brightness, so that the albedos
    have the fewest colours; return whether it changed.

    Changes are harmonics of the log map, of one channel or of all three; each is tried by itself,
    in smaller and smaller steps. The light on the surface stays as bright as it was.
    """
    sky, points = scene.sky, shown(scene, problem)
    assert sky is not None
    if points is None:
        return False
    basis = real_harmonics(ORDER, sky.direction)[:, 1:]
    if problem.sun is not None:
        basis = torch.cat([basis, (problem.sun.amax(1, keepdim=True) > 0).float()], 1)
    basis = basis / basis.abs().amax(0)
    log_map = sky.log_radiance.detach()
    before = points.lit(log_map.exp()).log().mean(0)
    least = begin = float(points.entropy(points.lit(log_map.exp())[:, None]))
    channels = torch.cat([torch.ones(1, 3), torch.eye(3)])
    for step in (s for s in STEPS for _ in range(SWEEPS)):
        for change in step * basis.T[..., None]:
            tried = [log_map + sign * c * change for sign in (1, -1) for c in channels]
            lit = torch.stack([points.lit(m.exp()) for m in tried], 1)
            left, best = points.entropy(lit).min(0)
            if float(left) < least - WORTH:
                least, log_map = float(left), tried[int(best)]
    # Of the scale of light against albedo colours say nothing
    sky.log_radiance.copy_(log_map + before - points.lit(log_map.exp()).log().mean(0))
    return least < begin


@torch.no_grad()
def matte_albedo(scene: Scene, problem: Problem) -> Tensor:
    """Albedo [P, 3] of all points as some photographs of each have it under the scene's map,
    without what the specular layer sends there; NaN where none sees a point."""
    sky, seen = scene.sky, problem.seen
    assert sky is not None
    albedo = torch.full_like(seen.position, torch.nan)
    for point in (seen.offsets.diff() > 0).nonzero()[:, 0].split(POINTS):  # bounds memory
        normal = seen.normal[point]
        _, roughness, _ = scene.material(scene.field.features_at(seen.position[point]))
        roughness = widened(roughness, len(sky.direction))
        black = torch.zeros_like(normal)
        layer = normal, black, roughness, torch.full_like(black, brdf.F0)
        reach, between = _reaching(problem, point)
        lit = reach @ sky.radiance + between
        found = torch.zeros_like(normal)
        for sighting in sightings_of(problem, point, PHOTOGRAPHS).unbind(1):
            shine = draw_sightings(scene, problem, point, sighting, *layer)
            exposure = scene.exposed(torch.ones_like(shine), seen.view[sighting])
            through = 1 - brdf.specular_albedo((normal * seen.wo[sighting]).sum(1), roughness)
            matte = (seen.color[sighting] - shine) / exposure
            found += (matte / (lit * through[:, None]).clamp_min(DARK)).clamp(LOWEST, HIGHEST)
        albedo[point] = found / PHOTOGRAPHS
    return albedo


def _reaching(problem: Problem, point: Tensor) -> tuple[Tensor, Tensor]:
    """What nodes of the map [P, D], and what blocks them [P, 3], send to points [P] of albedo 1."""
    transport = problem.transport
    cosine = (problem.seen.normal[point] @ transport.direction.T).clamp_min(0)
    cosine *= problem.solid_angle / math.pi
    blocked = torch.einsum("pd,pdc->pc", cosine, transport.indirect[point].float())
    return transport.open[point].float() / 255 * cosine, blocked


def palette_entropy(log_albedo: Tensor) -> Tensor:
    """Entropy [K], in nats, of the colours [P, K, 3] of P points, K times: how many there are.

    Colours count as one in cells CELL wide; the mean over two grids of cells.
    """
    points, kinds, _ = log_albedo.shape
    count = torch.arange(points + 1.0)
    count_log = count * count.clamp_min(1).log()
    total = torch.zeros(kinds)
    for shift in (0.0, 0.5):
        cell = (log_albedo / CELL + shift).floor().long()
        entry = (cell * torch.tensor(PRIMES)).sum(2) % TABLE + TABLE * torch.arange(kinds)
        counts = torch.bincount(entry.flatten(), minlength=TABLE * kinds).view(kinds, TABLE)
        total += math.log(points) - count_log[counts].sum(1) / points
    return total / 2
