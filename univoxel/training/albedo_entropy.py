"""The light under which the albedo has the lowest entropy.

A diffuse point under one light shows its albedo times its irradiance, and neither alone. Under a
map that is brighter above than it was, or that lacks a sun, shades and shadows become paint. But
paint comes in few colours. Under the right light all that is painted alike has one albedo, in the
shade and outside of it; under a wrong one each colour is smeared over as many as there are kinds of
shade. So the map is brought to where the entropy of the albedos is least, in the two things that
the photographs determine least: a sun, and slow changes over the sphere.

Source: entropy as in Finlayson, Drew and Lu 2004, "Intrinsic images by entropy minimization"; the
few colours of a scene as in Gehler et al. 2011, "Recovering intrinsic images with a global sparsity
prior on reflectance"; the hash is that of Teschner et al. 2003.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from univoxel import brdf
from univoxel.render.observations import (
    JointProblem,
    MaterialLabels,
    has_one_light,
    mean_colors,
    observations_of,
    prefiltered_roughness,
    shade_observations,
    without_exposure,
)
from univoxel.scene import Scene
from univoxel.sphere import real_harmonics

# Points whose colours are compared, at most
POINTS = 3000
# Points below which nothing is compared
MIN_POINTS = 300
# Observations that each of them has at least
MIN_VIEWS = 3
# Linear radiance of the darkest channel of a point; less is noise of 8 bits
MIN_COLOR = 2e-3
# Share of the points that are no metal, at least: a few may be metal that was not recognised
MIN_PAINT = 0.5
# Log albedo whose colours count as one: the side of a cell
CELL = 0.15
# Shares of the light that a sun is tried to send, from every direction
SUN_SHARES = (0.35, 0.5, 0.65, 0.8, 0.9, 0.95)
# Nats of entropy that a sun has to save. Suns of half of the light or more save 0.12 to 0.3; of
# 46 trainings of the stress suite without one, one found a sun, in grainy photographs
SUN_GAIN = 0.08
# Share of the light of a point, in the mean, that an even sky sends at least
MIN_SKY = 0.1
# Mean cosine that counts for a node that hardly reaches any of the surface
MIN_REACH = 0.02
# Degree of the spherical harmonics that change the log map: halves and quarters of the sky
DEGREE = 2
# Log radiance by which each harmonic is changed, both ways, one after the other
STEPS = (0.5, 0.25, 0.12, 0.06)
# Passes over all harmonics with each step
SWEEPS = 2
# Nats of entropy that a change has to save: 15 for all of the points
MIN_GAIN = 0.005
# Observations of a point that its albedo is averaged over once the light is known
ALBEDO_VIEWS = 2
# Bounds of a diffuse albedo: coal and snow
ALBEDO = (0.01, 0.95)


DARK = 1e-6  # irradiance of a point that nothing seems to reach
TABLE = 2**14  # entries for the occupied cells, by hash
PRIMES = (73856093, 19349663, 83492791)
SUNS_AT_ONCE = 64
POINTS_AT_ONCE = 3000


@dataclass(frozen=True)
class PaintedPoints:
    """P points of the surface that show their paint, and how the D nodes of the map reach them."""

    point: Tensor  # [P] int64
    color: Tensor  # [P, 3] mean over the photographs
    reach: Tensor  # [P, D] radiance per radiance of the nodes, for albedo 1
    indirect: Tensor  # [P, 3] radiance from occluded directions, for albedo 1

    def irradiance(self, sky: Tensor) -> Tensor:
        """Of the points under a map [D, 3], over pi: [P, 3]; above 0."""
        return (self.reach @ sky + self.indirect).clamp_min(DARK)

    def entropy(self, irradiance: Tensor) -> Tensor:
        """Of the albedos, if irradiance over pi [P, K, 3] reaches the points: [K]."""
        log_albedo = (self.color[:, None] / irradiance.clamp_min(DARK)).log()
        return palette_entropy(log_albedo, CELL)


@dataclass(frozen=True)
class Sun:
    """A sun that leaves the surface fewer colours."""

    log_excess: Tensor  # [D, 3] what it adds to the log map
    share: float  # of the light
    direction: tuple[float, float, float]

    def __str__(self) -> str:
        x, y, z = self.direction
        azimuth, elevation = math.degrees(math.atan2(y, x)), math.degrees(math.asin(z))
        return (
            f"a sun at about {azimuth:.0f} degrees azimuth and {elevation:.0f} degrees elevation "
            f"gives {self.share:.0%} of the light"
        )


def painted_points(
    scene: Scene, problem: JointProblem, decisions: MaterialLabels
) -> PaintedPoints | None:
    """Some points that are no metal, not dark and seen often.

    None: there are too few, or most are metal, or each photograph has a light of its own, as a
    flash is, which determines more.
    """
    if not has_one_light(scene, problem):
        return None
    observations = without_exposure(scene, problem.observations)
    color = mean_colors(observations)
    usable = (observations.offsets.diff() >= MIN_VIEWS) & (color.amin(1) > MIN_COLOR)
    point = (usable & ~decisions.metal).nonzero()[:, 0]
    if len(point) < max(MIN_POINTS, MIN_PAINT * int(usable.sum())):
        return None
    point = point[torch.randperm(len(point))[:POINTS]]
    return PaintedPoints(point, color[point], *_reach(problem, point))


@torch.no_grad()
def fit_sun_(scene: Scene, problem: JointProblem, decisions: MaterialLabels) -> Sun | None:
    """Change the scene's map to an even sky and a sun, if one leaves the points fewer colours, and
    return the sun; None: the map stays.

    Compared are the map as it is, an even sky, and an even sky with a sun, for every direction of
    the map and some shares of the light.
    """
    points = painted_points(scene, problem, decisions)
    if points is None:
        return None
    sky, indirect = problem.sky, points.indirect
    irradiance = points.irradiance(sky.radiance)
    mean = irradiance.mean(0)
    mean_from_sky = (mean - indirect.mean(0)).clamp_min(MIN_SKY * mean)
    even_radiance = mean_from_sky / points.reach.sum(1).mean()  # [3] radiance of an even sky
    overcast = points.reach.sum(1, keepdim=True) * even_radiance + indirect
    min_reach = MIN_REACH * problem.solid_angle / math.pi
    power = mean / points.reach.mean(0).clamp_min(min_reach)[:, None]  # [D, 3] for all of the light
    entropy_without_sun = points.entropy(torch.stack([irradiance, overcast], 1)).min()
    entropy = sun_entropies(points, overcast, power)
    if entropy.min() > entropy_without_sun - SUN_GAIN:
        return None
    best_share, node = divmod(int(entropy.argmin()), len(power))
    share = SUN_SHARES[best_share]
    radiance = ((1 - share) * even_radiance).repeat(len(power), 1)
    log_excess = torch.zeros_like(radiance)
    log_excess[node] = (1 + share * power[node] / radiance[node]).log()
    sky.log_radiance.copy_(radiance.log() + log_excess)
    x, y, z = sky.direction[node].tolist()
    return Sun(log_excess, share, (x, y, z))


def sun_entropies(points: PaintedPoints, overcast: Tensor, power: Tensor) -> Tensor:
    """Entropy of the albedos under an even sky with a sun: [K, D], by SUN_SHARES and direction.

    Args:
        overcast: [P, 3] irradiance over pi under the even sky only.
        power: [D, 3] radiance of a node that would send all of the light.
    """
    entropy = torch.zeros(len(SUN_SHARES), len(power))
    for nodes in torch.arange(len(power)).split(SUNS_AT_ONCE):
        suns = points.reach[:, nodes, None] * power[nodes]
        for k, share in enumerate(SUN_SHARES):
            irradiance = (1 - share) * overcast[:, None] + share * suns
            entropy[k, nodes] = points.entropy(irradiance)
    return entropy


@torch.no_grad()
def minimise_entropy_(scene: Scene, problem: JointProblem, decisions: MaterialLabels) -> bool:
    """Change the scene's map slowly over the sphere, and a sun's brightness, so that the albedos
    have the fewest colours; return whether it changed.

    Changes are harmonics of the log map, of one channel or of all three. Each is tried by itself,
    in smaller and smaller steps. The light on the surface stays as bright as it was.
    """
    points = painted_points(scene, problem, decisions)
    if points is None:
        return False
    sky = problem.sky
    basis = real_harmonics(DEGREE, sky.direction)[:, 1:]  # [D, R]; the first is constant
    if decisions.sun is not None:
        basis = torch.cat([basis, (decisions.sun.amax(1, keepdim=True) > 0).float()], 1)
    basis = basis / basis.abs().amax(0)
    log_map = sky.log_radiance.detach()
    brightness = points.irradiance(log_map.exp()).log().mean(0)
    lowest = initial = float(points.entropy(points.irradiance(log_map.exp())[:, None]))
    channels = torch.cat([torch.ones(1, 3), torch.eye(3)])
    for step in (s for s in STEPS for _ in range(SWEEPS)):
        for change in step * basis.T[..., None]:
            candidates = [log_map + sign * c * change for sign in (1, -1) for c in channels]
            irradiance = torch.stack([points.irradiance(m.exp()) for m in candidates], 1)
            entropy, best = points.entropy(irradiance).min(0)
            if float(entropy) < lowest - MIN_GAIN:
                lowest, log_map = float(entropy), candidates[int(best)]
    # Colours do not determine the scale of light against albedo
    sky.log_radiance.copy_(log_map + brightness - points.irradiance(log_map.exp()).log().mean(0))
    return lowest < initial


@torch.no_grad()
def diffuse_albedo(scene: Scene, problem: JointProblem) -> Tensor:
    """Albedo [P, 3] of all points, from some photographs of each under the scene's map and without
    the specular layer; NaN where none sees a point."""
    observations = problem.observations
    albedo = torch.full_like(observations.position, torch.nan)
    seen_points = (observations.offsets.diff() > 0).nonzero()[:, 0]
    for point in seen_points.split(POINTS_AT_ONCE):
        normal = observations.normal[point]
        features = scene.field.features_at(observations.position[point])
        roughness = prefiltered_roughness(scene.material(features)[1], problem.nodes)
        black = torch.zeros_like(normal)
        specular_layer = normal, black, roughness, torch.full_like(black, brdf.F0)
        reach, indirect = _reach(problem, point)
        irradiance = reach @ problem.sky.radiance + indirect
        total = torch.zeros_like(normal)
        for observation in observations_of(problem, point, ALBEDO_VIEWS).unbind(1):
            specular = shade_observations(scene, problem, point, observation, *specular_layer)
            exposure = scene.exposed(torch.ones_like(specular), observations.view[observation])
            cosine = (normal * observations.wo[observation]).sum(1)
            factor = 1 - brdf.specular_albedo(cosine, roughness)
            diffuse = (observations.color[observation] - specular) / exposure
            white_radiance = (irradiance * factor[:, None]).clamp_min(DARK)
            total += (diffuse / white_radiance).clamp(*ALBEDO)
        albedo[point] = total / ALBEDO_VIEWS
    return albedo


def _reach(problem: JointProblem, point: Tensor) -> tuple[Tensor, Tensor]:
    """What nodes of the map [P, D], and what occludes them [P, 3], send to points [P] of albedo
    1."""
    transport = problem.transport
    cosine = (problem.observations.normal[point] @ transport.direction.T).clamp_min(0)
    cosine *= problem.solid_angle / math.pi
    indirect = torch.einsum("pd,pdc->pc", cosine, transport.indirect[point].float())
    return transport.visibility[point].float() / 255 * cosine, indirect


def palette_entropy(log_albedo: Tensor, cell: float) -> Tensor:
    """Entropy [K], in nats, of the colours [P, K, 3] of P points, K times: how many there are.

    Colours count as one in cubes with a side of `cell`; the mean over two grids of cubes.
    """
    points, kinds, _ = log_albedo.shape
    count = torch.arange(points + 1.0)
    count_log = count * count.clamp_min(1).log()
    total = torch.zeros(kinds)
    for shift in (0.0, 0.5):
        cube = (log_albedo / cell + shift).floor().long()
        entry = (cube * torch.tensor(PRIMES)).sum(2) % TABLE + TABLE * torch.arange(kinds)
        counts = torch.bincount(entry.flatten(), minlength=TABLE * kinds).view(kinds, TABLE)
        total += math.log(points) - count_log[counts].sum(1) / points
    return total / 2
