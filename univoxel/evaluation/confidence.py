"""How wrong a scene's materials and normals are expected to be, and what to photograph next: points
of the surface, expected errors anywhere, figures and words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import normalize

from univoxel import brdf
from univoxel.camera import Cameras
from univoxel.color import CLIPPED, linear_to_srgb_unclipped
from univoxel.core.records import Mesh, Surface
from univoxel.core.validation import check_settings, setting
from univoxel.data import Photos
from univoxel.ops import VisibilityScene
from univoxel.render.observations import (
    MIN_COSINE,
    JointProblem,
    Observations,
    Transport,
    mean_colors,
    observe,
    prefiltered_roughness,
    shade_observations,
    surface_points,
    trace,
    turned_maps,
    without_exposure,
)
from univoxel.render.pipeline import RAYS_AT_ONCE, at_rays, extract_mesh, shade
from univoxel.scene import Scene
from univoxel.sphere import fibonacci_sphere, gaps, side_of

# Points of the surface, and what the photographs fix of each.
#
# No truth is read: only the photographs that were trained on, and the scene.
# docs/method/detail.md explains the terms.


POINTS = 20_000  # of the surface that evaluation surveys, for its maps of expected errors
REPORT_POINTS = 2_000  # of the surface that are surveyed after training, for words only

OBSERVATIONS = 8  # of a point that are rendered again, at most
DIRECTIONS = 64  # directions that visibility is measured in where the scene has no map with its own
ROUGHNESS_STEP = 0.05  # roughness over which the slope of the render is taken
ENOUGH_VIEWS = 3.0  # views straight from above with which a place counts as half seen
# sRGB; disagreement with the photographs with which they count as half agreeing
NOISE = 0.02
# sRGB; darker pixels are noise
BLACK = 0.02

# Mean errors of places like this on rendered scenes: exp(constant + sum of weight * term), with the
# terms of `Survey.terms`. Fitted to the tuning half of the bank by benchmarks/expected_errors.py
QUANTITIES = ("albedo", "roughness", "normal")  # sRGB, as it is, degrees
EXPECTED = {
    "albedo": (-3.83, {"undetermined": 2.44, "variation": 0.30, "clipped": 0.80}),
    "roughness": (-1.48, {"disagreement": 0.29, "roughness": 1.38}),
    "normal": (0.76, {"bumpiness": 0.31, "visibility": -0.96, "spread": 0.64}),
}
# sRGB; an expected error of the albedo that pictures show brightest
ALBEDO_LIMIT = 0.2
# Mean errors of the same scenes where no photograph sees the surface; and bounds of any error
UNSEEN, LARGEST = (0.12, 0.2, 17.0), (1.0, 1.0, 90.0)
# Points of the surface that bumpiness and variation are taken from, and how many lie around one
AROUND_POINTS, AROUND = 20_000, 24


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
    disagreement_nearby: Tensor  # its mean over the nearest points
    bumpiness: Tensor  # 1 - mean cosine of the normal and those around
    variation: Tensor  # standard deviation of the log albedo around, mean of the channels
    recovered_roughness: Tensor
    gloss: Tensor  # root of the sum over the views of (change of sRGB by roughness)^2

    @property
    def terms(self) -> dict[str, Tensor]:
        """What expected errors depend on, [P] each."""
        determined = self.seen_with(self.straight) * self.visibility * self.agreeing
        return {
            "undetermined": 1 - determined,
            "disagreement": self.disagreement_nearby.clamp_min(0.003).log(),
            "visibility": self.visibility.clamp_min(0.05).log(),
            "variation": self.variation.clamp_min(0.01).log(),
            "bumpiness": self.bumpiness.clamp_min(1e-3).log(),
            "spread": self.spread.clamp_min(2.0).log(),
            "clipped": self.clipped,
            "roughness": self.recovered_roughness,
        }

    @property
    def errors(self) -> Tensor:
        """Expected errors [P, 3] of QUANTITIES, see EXPECTED."""
        terms, found = self.terms, []
        bounds = UNSEEN, LARGEST, EXPECTED.values()
        for guess, largest, (constant, weights) in zip(*bounds, strict=True):
            log_error = constant + sum(weight * terms[name] for name, weight in weights.items())
            assert isinstance(log_error, Tensor)
            error = log_error.exp().clamp_max(largest)
            found.append(torch.where(self.views > 0, error, guess))
        return torch.stack(found, 1)

    def seen_with(self, straight: Tensor) -> Tensor:
        """How well points are seen, [..., P] in [0, 1], with such sums of squared cosines."""
        return straight / (straight + ENOUGH_VIEWS)

    @property
    def agreeing(self) -> Tensor:
        """How well render and photographs agree, in (0, 1]."""
        return NOISE / (self.disagreement + NOISE)

    @property
    def information(self) -> Tensor:
        """That photographs have of roughness, over that of knowing [0, 1] only, whose variance is
        1/12: each sRGB value has the noise NOISE."""
        return (self.gloss / NOISE).square() / 12


@torch.no_grad()
def survey(scene: Scene, photos: Photos, points: int) -> Survey:
    """How well the training photographs determine points of the surface, spread evenly; a
    ValueError if the scene has none."""
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
    disagreement, gloss = compare(scene, observations, transport, compared)
    key = key_of(position, normal, offset)
    count = min(points, max(1, AROUND * points // AROUND_POINTS))
    nearest = KDTree(key).query(key, k=count, workers=-1)[1].reshape(points, count)
    bumpiness, variation = surroundings(scene, mesh, position, normal)
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
        disagreement_nearby=disagreement[torch.from_numpy(nearest)].mean(1),
        bumpiness=bumpiness,
        variation=variation,
        recovered_roughness=scene.material(scene.field.features_at(position))[1],
        gloss=gloss * counts.sqrt(),
    )


def surroundings(
    scene: Scene, mesh: Mesh, position: Tensor, normal: Tensor
) -> tuple[Tensor, Tensor]:
    """Bumpiness and variation of the albedo around points [P, 3] of a mesh: [P] each, see `Survey`.

    What counts as around depends on the size of the object alone.
    """
    voxel_size, generator = scene.field.voxel_size, torch.Generator().manual_seed(0)
    near, near_normal = surface_points(mesh, AROUND_POINTS, generator)
    log_albedo = scene.material(scene.field.features_at(near))[0].clamp_min(0.01).log().mean(1)
    around = KDTree(near.numpy()).query(position.numpy(), k=AROUND, workers=-1)[1]
    cosine = (near_normal[torch.from_numpy(around)] * normal[:, None]).sum(2)
    # Paint on the other side of a thin part is none of a point's surroundings
    tree = KDTree(key_of(near, near_normal, voxel_size))
    same_side = tree.query(key_of(position, normal, voxel_size), k=AROUND, workers=-1)[1]
    return 1 - cosine.mean(1), log_albedo[torch.from_numpy(same_side)].std(1)


def spread_observations(observations: Observations, most: int) -> tuple[Tensor, Tensor]:
    """At most so many observations of each point, spread over all: their points and numbers."""
    counts = observations.offsets.diff()[:, None]
    which = torch.arange(most) * counts.clamp_min(most) // most
    point, _ = (which < counts).nonzero().unbind(1)
    return point, (observations.offsets[:-1, None] + which)[which < counts]


def compare(
    scene: Scene, observations: Observations, transport: Transport, which: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """Mean absolute sRGB difference between photographs and render, and root mean square of the
    render's slope by roughness: [P] each; 0 for points without observations.

    A clipped pixel is only a lower bound on the brightness.

    Args:
        which: indices of the points and observations that are compared.
    """
    point, observation = which
    features = scene.field.features_at(observations.position)
    albedo, roughness, metallic = scene.material(features)
    step = torch.where(roughness > 0.5, -ROUGHNESS_STEP, ROUGHNESS_STEP)
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
            at_points = replace(at_points, depth=observations.away(point[k], o))
            parts.append(shade(scene, at_points, observations.wo[o], view=view))
        return torch.cat(parts) if parts else torch.zeros(0, 3)
    assert surface.metallic is not None
    diffuse, f0 = brdf.split(surface.albedo, surface.metallic)
    assert isinstance(f0, Tensor)
    color, voxel_size = observations.color, scene.field.voxel_size
    turned = turned_maps(scene, observations)
    problem = JointProblem(
        observations, transport, color, voxel_size, scene.sky, turned, scene.flash
    )
    roughness = prefiltered_roughness(surface.roughness, problem.nodes)
    shaded = observations.normal[point], diffuse[point], roughness[point], f0[point]
    return shade_observations(scene, problem, point, observation, *shaded)


# Expected errors anywhere on the surface.


# Voxels, over 2, that opposite sides of a thin part count as farther apart: a pixel takes its
# expected error from its own side
NORMAL_SCALE = 3.0
NEIGHBOURS = 4  # nearest points that a pixel takes its expected error from


def key_of(position: Tensor, normal: Tensor, voxel_size: float) -> np.ndarray:
    """Where points [P, 3] lie for a search of the nearest ones on the same side: [P, 6]."""
    return torch.cat([position, NORMAL_SCALE * voxel_size * normal], 1).numpy()


class ExpectedErrors:
    """Expected errors of a survey, which can be looked up anywhere on the surface."""

    def __init__(self, surveyed: Survey) -> None:
        self._voxel_size = surveyed.voxel_size
        self._values = surveyed.errors
        self._tree = KDTree(key_of(surveyed.position, surveyed.normal, self._voxel_size))

    def at(self, position: Tensor, normal: Tensor) -> Tensor:
        """Expected errors [N, 3] of QUANTITIES at points [N, 3] with normals [N, 3]: the mean of
        the nearest points, weighted by the inverse squared distance."""
        count = min(NEIGHBOURS, len(self._values))
        key = key_of(position, normal, self._voxel_size)
        nearest = self._tree.query(key, k=count, workers=-1)
        distance, index = (torch.from_numpy(x.reshape(-1, count)) for x in map(np.asarray, nearest))
        weight = 1 / (distance.square() + 1e-12)
        weight = (weight / weight.sum(1, keepdim=True)).float()
        return (self._values[index] * weight[..., None]).sum(1)


# A survey in figures and in words.


# Expected error below which a place counts as good, and the error below which nine of ten such
# places were on the tuning half of the bank. No expected roughness is so certain
GOOD = {"albedo": (0.05, 0.1), "normal": (8.0, 10.0)}
UNITS = {"albedo": "", "normal": " degrees"}
FEW_VIEWS = 3  # views; a material that fewer see is reported as a guess
ONE_SIDE = 15.0  # degrees of spread; views within are reported as one direction
MIN_VISIBILITY = 0.5  # share of a point's light; where less comes from outside, that is reported
# Mean absolute difference of render and photographs, sRGB; where it is more, that is reported:
# surface, material or light is wrong
MAX_DISAGREEMENT = 0.05
MIN_SHARE = 0.01  # share of the surface below which nothing is reported about it


def numbers(surveyed: Survey) -> dict[str, float]:
    """The survey in figures: means over the surface, shares of it in [0, 1]."""

    def share(where: Tensor) -> float:
        return where.float().mean().item()

    seen = surveyed.views > 0
    errors: dict[str, Tensor] = dict(zip(QUANTITIES, surveyed.errors.unbind(1), strict=True))
    return {
        **{f"{name}_error": error.mean().item() for name, error in errors.items()},
        **{f"{name}_good": share(errors[name] < most) for name, (most, _) in GOOD.items()},
        "unseen": share(~seen),
        "few_views": share(surveyed.views < FEW_VIEWS),
        "one_side": share(seen & (surveyed.spread < ONE_SIDE)),
        "clipped": share(surveyed.clipped > 0.5),
        "black": share(surveyed.black > 0.5),
        "shut": share(surveyed.visibility < MIN_VISIBILITY),
        "disagreeing": share(surveyed.disagreement > MAX_DISAGREEMENT),
        "dull": share(surveyed.information < 1),
    }


def words(figures: dict[str, float], troubles: list[str]) -> str:
    """The figures as a paragraph, with what went wrong in training; findings that do not apply are
    left out."""
    sentences = [
        f"Mean expected error of the surface: {figures['albedo_error']:.2f} for the albedo (in "
        f"sRGB), {figures['roughness_error']:.2f} for the roughness, {figures['normal_error']:.0f} "
        "degrees for the normals.",
        *(
            f"On {figures[f'{name}_good']:.0%} of the surface, the {name} is good: on rendered "
            f"scenes, nine of ten such places have an error below {limit:g}{UNITS[name]}."
            for name, (_, limit) in GOOD.items()
        ),
    ]
    shares = {
        "few_views": f"is seen by fewer than {FEW_VIEWS} cameras: its materials are a guess",
        "one_side": f"is seen only within {ONE_SIDE:g} degrees of one direction: colour and "
        "highlight cannot be separated there",
        "clipped": "is overexposed in most photographs: use shorter exposures",
        "black": "is black in most photographs: use more light",
        "shut": f"gets less than {MIN_VISIBILITY:.0%} of its light from outside: light reflected "
        "between parts of the object may remain in its albedo",
        "disagreeing": f"differs from its photographs by more than {MAX_DISAGREEMENT:g} in sRGB: "
        "shape, material or light is wrong",
        "dull": "shows no highlight, so its roughness is a guess",
    }
    for name, text in shares.items():
        if figures[name] >= MIN_SHARE:
            sentences.append(f"{figures[name]:.0%} of the surface {text}.")
    sentences.append(
        "A bright albedo and a bright light look the same in photographs, so compare albedos with "
        "one another, not with a colour chart."
    )
    if troubles:
        last = f"The last one: {troubles[-1]}."
        sentences.append(f"Failures from which training recovered: {len(troubles)}. {last}")
    return " ".join(sentences)


# What to photograph next: the directions from which most of what is badly seen would be seen.
#
# A photograph is worth what it adds to how well the surface is seen, see `Survey.seen_with`, over
# points weighted by how little is known of them. Directions are taken one after another, the best
# first, each with those before it taken as photographs. No truth is read.


CANDIDATES = 600  # directions that are weighed, on the whole sphere
APART = 25.0  # degrees; photographs nearer to one another show much the same
GAP = 30.0  # degrees to the nearest photograph; directions beyond are a gap
# Degrees below which nobody is sent, unless a photograph was taken from there: things stand on
# something
LOWEST = 0.0


STEEP = 65.0  # degrees above or below the horizon, from where on a view has no side
BEST = 0.9  # quantile of the agreement of render and photographs that counts as the best
COUNTS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine")


@dataclass(frozen=True)
class AdviceConfig:
    """How directions for more photographs are chosen."""

    most: int = setting(6, "maximum number of directions", least=1)
    least: float = setting(
        0.006,
        "minimum worth of a photograph: the share of the surface that it would show better, times "
        "the uncertainty there",
        least=0,
        most=1,
    )
    share: float = setting(0.5, "minimum worth, relative to the best photograph", least=0, most=1)

    __post_init__ = check_settings


ADVICE = AdviceConfig()


@dataclass(frozen=True)
class Advice:
    """Where photographs were taken around an object, and where more would help.

    V photographs, C directions that were weighed, K that are advised, the best first. Directions
    are unit vectors from the middle of the object.
    """

    taken: Tensor  # [V, 3]
    names: list[str]  # V, of the photographs
    front: float  # azimuth of what is called the front, degrees from +X
    front_name: str  # the photograph that says so
    weighed: Tensor  # [C, 3]
    worth: Tensor  # [C] in [0, 1], before any was taken
    least: float  # worth below which no direction is advised, `AdviceConfig.least`
    gap: Tensor  # [C] bool: no photograph is near
    chosen: Tensor  # [K, 3]
    gains: Tensor  # [K] worth of each, with those before it taken
    hidden: float  # share of the surface that no photograph shows, nor any from these directions

    @property
    def nearest(self) -> list[str]:
        """Of each advised direction, the photograph that was taken nearest to it."""
        return [self.names[i] for i in (self.chosen @ self.taken.T).argmax(1).tolist()]


@torch.no_grad()
def advise(
    surveyed: Survey,
    cameras: Cameras,
    names: Sequence[str],
    surface: VisibilityScene,
    cfg: AdviceConfig = ADVICE,
) -> Advice:
    """Weigh directions for more photographs, as far away as those there are.

    Args:
        surveyed: what the photographs fix.
        cameras, names: of the photographs, V >= 1.
        surface: what is in the way.
    """
    low, high = surveyed.position.amin(0), surveyed.position.amax(0)
    middle = (low + high) / 2
    away = cameras.camera_to_world[:, :, 3] - middle
    taken, distance = normalize(away, dim=1), float(away.norm(dim=1).median())
    lowest = min(LOWEST, float(elevations(taken).min()))
    weighed = fibonacci_sphere(CANDIDATES)
    weighed = weighed[elevations(weighed) >= min(lowest, 89.0)]
    shown = torch.stack([_shown(surveyed, surface, middle + distance * w) for w in weighed])

    straight = surveyed.straight.clone()
    # Beside the best of the surface: what disagrees everywhere, as after a short training, is
    # repaired by no photograph
    agreeing = (surveyed.agreeing / surveyed.agreeing.quantile(BEST)).clamp_max(1)
    nearest = _degrees(weighed, taken).amin(1)
    gap, first = nearest > GAP, None
    chosen, gains = [], []
    while True:
        gain = (surveyed.seen_with(straight + shown) - surveyed.seen_with(straight)) @ (
            1 - surveyed.seen_with(straight) * agreeing
        )
        gain = gain / len(straight) * (nearest / APART).clamp_max(1)
        first = gain if first is None else first
        best = int(gain.argmax())
        least = max(cfg.least, cfg.share * gains[0]) if gains else cfg.least
        if len(chosen) == cfg.most or gain[best] < least:
            break
        chosen.append(best)
        gains.append(float(gain[best]))
        straight = straight + shown[best]
        nearest = torch.minimum(nearest, _degrees(weighed, weighed[best : best + 1])[:, 0])
    # The first photograph that was taken from a side; argmax of none is the first of all
    front = int((elevations(taken).abs() < STEEP).int().argmax())
    hidden = (surveyed.views == 0) & (shown.amax(0) == 0)
    return Advice(
        taken=taken,
        names=list(names),
        front=float(azimuths(taken[front : front + 1])[0]),
        front_name=names[front],
        weighed=weighed,
        worth=first,
        least=cfg.least,
        gap=gap,
        chosen=weighed[chosen],
        gains=torch.tensor(gains),
        hidden=float(hidden.float().mean()),
    )


def _shown(surveyed: Survey, surface: VisibilityScene, eye: Tensor) -> Tensor:
    """Squared cosine [P] at which a camera sees points; 0 where it does not, as in `observe`."""
    towards = normalize(eye - surveyed.position, dim=1)
    cosine = (surveyed.normal * towards).sum(1)
    facing = (cosine > MIN_COSINE).nonzero()[:, 0]
    offset = surveyed.voxel_size * (surveyed.normal[facing] + towards[facing])
    start = surveyed.position[facing] + offset
    reach = float((eye - start).norm(dim=1).max()) if len(facing) else 0.0
    found = torch.zeros_like(cosine)
    visible = ~surface.occluded(start, towards[facing], 0.0, reach)
    found[facing] = cosine[facing].square() * visible
    return found


def _degrees(a: Tensor, b: Tensor) -> Tensor:
    """Angles [A, B] between unit vectors [A, 3] and [B, 3]."""
    return (a @ b.T).clamp(-1, 1).acos().rad2deg()


def azimuths(direction: Tensor) -> Tensor:
    """Degrees [N] counter-clockwise from +X, of directions [N, 3]."""
    return torch.atan2(direction[:, 1], direction[:, 0]).rad2deg()


def elevations(direction: Tensor) -> Tensor:
    """Degrees [N] above the horizon, of unit directions [N, 3]."""
    return direction[:, 2].clamp(-1, 1).asin().rad2deg()


def place(advice: Advice, direction: Tensor) -> str:
    """A direction [3] in words: a side, or above or below."""
    up = float(elevations(direction[None])[0])
    if abs(up) >= STEEP:
        return "above" if up > 0 else "below"
    return f"the {side_of(float(azimuths(direction[None])[0]) - advice.front)}"


def in_words(advice: Advice) -> list[str]:
    """What to photograph next, a sentence for each side, the most useful first."""
    sides: dict[str, list[int]] = {}
    for k, direction in enumerate(advice.chosen):
        sides.setdefault(place(advice, direction), []).append(k)
    up = elevations(advice.chosen).tolist() if len(advice.chosen) else []
    told = []
    for side, which in sorted(sides.items(), key=lambda s: -float(advice.gains[s[1]].sum())):
        count = COUNTS[len(which)] if len(which) < len(COUNTS) else str(len(which))
        noun = "photograph" if len(which) == 1 else "photographs"
        height = "" if side in ("above", "below") else f", {_heights([up[k] for k in which])}"
        told.append(f"{count} {noun} from {side}{height}".capitalize())
    return told


def _heights(up: list[float]) -> str:
    """Elevations in degrees as a range of tens."""
    low, high = 10 * math.floor(min(up) / 10), 10 * math.ceil(max(up) / 10)
    high = max(high, low + 10)
    if low >= 0:
        return f"{low} to {high} degrees above the horizon"
    if high <= 0:
        return f"{-high} to {-low} degrees below the horizon"
    return f"from {-low} degrees below to {high} degrees above the horizon"


def missing(advice: Advice, gap: float) -> list[str]:
    """Sides that photographs are missing from, as `univoxel poses` tells of them."""
    return gaps(advice.taken.numpy(), advice.names, gap, advice.front)
