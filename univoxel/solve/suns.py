"""A sun in the map, told by the shadows that would otherwise be painted on the surface.

A diffuse point under one light shows its albedo times its irradiance and nothing of either: under a
map that is bright all over, the shadows of a sun are paint. But paint comes in few colours. Under
the right light all that is painted alike has one albedo, in the shadow and outside of it; under a
wrong one each colour is smeared over as many as there are kinds of shade.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from univoxel.render.transport import mean_colors
from univoxel.scene import Scene
from univoxel.solve.sightings import Problem, unexposed

POINTS, FEWEST = 3000, 300  # that are looked at
SIGHTINGS = 3  # that each has at least
DARKEST = 2e-3  # linear; less is noise of 8 bits
SHARES = (0.35, 0.5, 0.65, 0.8, 0.9, 0.95)  # of the surface's light, tried for every direction
# Nats that a sun has to save of the entropy. Suns of half of the light or more save 0.12 to 0.3; on
# eight scenes without, the best of all these suns saved up to 0.06
CLEARER = 0.08
CELL = 0.15  # of log albedo, whose colours count as one
TABLE = 2**14  # entries for the occupied cells, by hash
AT_ONCE = 64  # suns
LEAST_REACH = 0.02  # mean cosine that counts for a node that hardly reaches any of the surface
PRIMES = (73856093, 19349663, 83492791)


@torch.no_grad()
def sunlit(scene: Scene, problem: Problem, say: Callable[[str], None]) -> Problem:
    """The problem and the scene's map with a sun, if one leaves the points fewer colours.

    Compared are the map as it is, an even sky, and an even sky with a sun, for every direction of
    the map and some shares, by the entropy of the albedos that they leave. With a sun the map
    becomes that sky and sun.

    Args:
        say: called with a sentence where there is one.

    Source: entropy as in Finlayson, Drew and Lu 2004, "Intrinsic images by entropy minimization",
    and the few colours of a scene as in Gehler et al. 2011, "Recovering intrinsic images with a
    global sparsity prior on reflectance"; the hash is that of Teschner et al. 2003.
    """
    sky, seen = scene.sky, unexposed(scene, problem.seen)
    assert sky is not None
    if scene.views is not None and scene.views.sky_change() is not None:
        return problem  # each photograph has a light of its own, which tells more
    color = mean_colors(seen)
    usable = (seen.offsets.diff() >= SIGHTINGS) & ~problem.metal & (color.amin(1) > DARKEST)
    point = usable.nonzero()[:, 0]
    if len(point) < FEWEST:
        return problem
    point = point[torch.randperm(len(point))[:POINTS]]
    reach, between = _reaching(problem, point)
    lit = reach @ sky.radiance + between  # [P, 3]
    mean = lit.mean(0)
    even = (mean - between.mean(0)).clamp_min(0.1 * mean) / reach.sum(1).mean()
    overcast = reach.sum(1, keepdim=True) * even + between
    least = LEAST_REACH * problem.solid_angle / math.pi
    power = mean / reach.mean(0).clamp_min(least)[:, None]  # [D, 3] for all of the light

    def left(light: Tensor) -> Tensor:
        return palette_entropy((color[point, None] / light.clamp_min(1e-6)).log())

    without = left(torch.stack([lit, overcast], 1)).min()
    tried = torch.zeros(len(SHARES), len(power))
    for some in torch.arange(len(power)).split(AT_ONCE):
        suns = reach[:, some, None] * power[some]
        for k, share in enumerate(SHARES):
            tried[k, some] = left((1 - share) * overcast[:, None] + share * suns)
    if tried.min() > without - CLEARER:
        return problem
    best, node = divmod(int(tried.argmin()), len(power))
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
    reach, between = _reaching(problem, torch.arange(len(color)))
    albedo = color / (reach @ sky.radiance + between).clamp_min(1e-6)
    return replace(problem, sun=sun, albedo=albedo.clamp(0, 1))


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
