"""What the joint solve is made of: how long it takes, what it weighs, where it decides."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from univoxel.validation import check_fields

_WHOLE = ("at least 1", lambda x: x >= 1)
_ABOVE = ("above 0", lambda x: 0 < x < math.inf)
_NOT_BELOW = ("at least 0", lambda x: 0 <= x < math.inf)
_SHARE = ("in (0, 1]", lambda x: 0 < x <= 1)
_FROM_ZERO = ("in [0, 1]", lambda x: 0 <= x <= 1)
_SHARES = ("numbers in (0, 1)", lambda x: len(x) >= 1 and all(0 < v < 1 for v in x))
_SKY_ROWS = ("a multiple of 32 in [0, 1024]", lambda x: x in range(0, 1025, 32))
_RANGE = ("two numbers in [0, 1], rising", lambda x: len(x) == 2 and 0 <= x[0] < x[1] <= 1)


@dataclass(frozen=True)
class SurfaceConfig:
    """Points of the surface that the joint solve samples, see joint/observations.py."""

    # points that are traced on a machine however slow, >= 1; on a fast one JointConfig.points
    min_points: int = 2000
    # vertices of the mesh whose colour is looked up in the photographs, >= 1; the others of a
    # larger mesh take that of the nearest, for memory. Meshes of the presets have fewer
    vertices: int = 300_000

    def __post_init__(self) -> None:
        check_fields(self, *_WHOLE, "min_points", "vertices")


@dataclass(frozen=True)
class NewtonConfig:
    """Gauss-Newton steps on the environment map, see joint/newton.py."""

    # observations that a point needs, >= 2: in a single one its colour explains everything
    min_views: int = 2
    # sRGB, > 0; the scale of the Cauchy weights: residuals beyond are what no model explains
    cauchy: float = 0.05
    # sRGB, > 0; what is left of an observation under the true map and materials. It weighs the
    # prior of roughness against the observations
    noise: float = 0.02
    # roughness, > 0, over which slopes by roughness are taken
    roughness_step: float = 0.02
    # log radiance, > 0, by which a step changes a node of the map, or a view's gain, at most
    max_map_change: float = 1.0
    # log albedo, > 0, by which a step changes a point at most
    max_albedo_change: float = 0.5
    # roughness, > 0, by which a step changes a point at most
    max_roughness_change: float = 0.1
    # log albedo below which no point goes, <= 0: what is blacker does not determine the light
    min_log_albedo: float = -7.0
    # weight, > 0, of the prior on changes of a view's own map, in units of newton_smooth
    view_prior: float = 10.0
    # nearest nodes of the map that the smoothness ties a node to, >= 1: as many as lie around one
    neighbours: int = 6
    # parts of the points, >= 1, that a step builds its equations from on a machine however slow
    min_parts: int = 2
    # seconds of an observation in a Newton step over one in an Adam step, > 0; measured, with the
    # trials and the search for metals. Only a first guess of the time to reserve
    cost: float = 6.5

    def __post_init__(self) -> None:
        check_fields(self, "at least 2", lambda x: x >= 2, "min_views")
        check_fields(self, *_WHOLE, "neighbours", "min_parts")
        changes = ("max_map_change", "max_albedo_change", "max_roughness_change")
        scales = ("cauchy", "noise", "roughness_step", "view_prior", "cost")
        check_fields(self, *_ABOVE, *changes, *scales)
        check_fields(self, "at most 0", lambda x: -math.inf < x <= 0, "min_log_albedo")


@dataclass(frozen=True)
class MetalConfig:
    """Which points are metal, see joint/metals.py."""

    # metallic, [0, 1], from which on the stages before have taken a point for metal
    metallic_before: float = 0.2
    # roughnesses in (0, 1] that are tried, from a mirror to chalk
    roughness: tuple[float, ...] = (0.1, 0.2, 0.3, 0.45, 0.65, 0.9)
    # Gauss-Newton steps on a base colour, >= 1
    steps: int = 5
    # bounds of a base colour, in [0, 1]
    base: tuple[float, float] = (0.005, 1.0)
    # brightest channel of a metal at least, [0, 1]: metals in use reflect 0.4 and more
    min_reflectance: float = 0.25
    # points whose evidence is averaged, >= 1: that of one alone is too noisy
    neighbours: int = 32
    # voxels, > 0, that count as one unit of distance between points
    near: float = 4.0
    # log albedo, > 0, that counts as one unit of distance between points
    alike: float = 0.5
    # bound, > 0, of the log ratio of one point: a single one does not decide for its neighbours
    max_evidence: float = 2.0
    # median, (0, 1), of the brightest channel where all is metal: nothing else tells how bright the
    # light is
    only_metal_albedo: float = 0.3
    # log ratio of residuals, metal over dielectric, below which a point is metal: under the first
    # map and under the last. The first asks for more: the map is wrong yet, and metals make the
    # next one
    threshold: tuple[float, float] = (-0.4, -0.15)

    def __post_init__(self) -> None:
        check_fields(self, *_FROM_ZERO, "metallic_before", "min_reflectance")
        check_fields(self, "in (0, 1)", lambda x: 0 < x < 1, "only_metal_albedo")
        wanted = "numbers in (0, 1]"
        check_fields(
            self, wanted, lambda x: len(x) >= 1 and all(0 < v <= 1 for v in x), "roughness"
        )
        check_fields(self, *_WHOLE, "steps", "neighbours")
        check_fields(self, *_RANGE, "base")
        check_fields(self, *_ABOVE, "near", "alike", "max_evidence")
        check_fields(
            self,
            "two numbers below 0",
            lambda x: len(x) == 2 and all(-math.inf < v < 0 for v in x),
            "threshold",
        )


@dataclass(frozen=True)
class MirrorConfig:
    """Which points mirror the map, see joint/mirrors.py."""

    # observations of a point that are compared, >= 1
    views: int = 16
    # of them, that mirror the sky, at least, >= 1; other points are as their neighbours
    min_views: int = 3
    # cosine, [0, 1], between normal and eye of an observation, at least
    min_cosine: float = 0.2
    # points whose changes, colours and normals are averaged, >= 1
    neighbours: int = 32
    # points, >= 1, most of which decide for each among them
    voters: int = 96
    # difference of unit normals, > 0, that counts as one unit of distance between points
    turn: float = 0.5
    # change of metal from view to view, linear, >= 0, at least: mean deviation from the mean
    change: float = 0.05
    # part, (0, 1], of the change of what it mirrors. Metals of the scenes reach 0.6 to 1, glossy
    # paint 0.1 to 0.45
    reflected: float = 0.55
    # the same, >= 1, at most: nothing mirrors more than it gets. Metals reach 1.15, whose normals
    # are off; under a sun, which leaves the rest of the map dark, paint reaches 1.5 to 15
    reflected_at_most: float = 1.25
    # part, (0, 1], of the change that the map leaves unexplained where metal mirrors sharply
    sharp: float = 0.6
    # brightest channel of a metal at least, [0, 1]
    min_reflectance: float = 0.25
    # degrees, > 0, around a direction, whose brightest node tells how dark it is
    around: float = 27.0
    # share, (0, 1], of the directions, the darkest, that base colours are read from
    darkest: float = 0.25
    # length, [0, 1], of the mean of neighbouring normals, above which a surface is not thin
    flat: float = 0.7
    # cosine, [0, 1], between normals above which they are averaged
    alike: float = 0.3
    # weight, >= 0, of what was found of sharp points, in Adam
    weight: float = 1.0
    # degrees, each > 0, by which normals of sharp points are turned at most, search by search
    turns: tuple[float, ...] = (6.0, 3.0)
    # rows of the map as sharp points show it, a multiple of 32; 0: it is not kept
    rows: int = 128

    def __post_init__(self) -> None:
        check_fields(self, *_WHOLE, "views", "min_views", "neighbours", "voters")
        check_fields(self, *_SKY_ROWS, "rows")
        above = "above 0 each", lambda turns: all(0 < x < math.inf for x in turns)
        check_fields(self, *above, "turns")
        check_fields(self, *_FROM_ZERO, "min_cosine", "min_reflectance", "flat", "alike")
        check_fields(self, *_NOT_BELOW, "change", "weight")
        check_fields(self, *_ABOVE, "turn", "around")
        check_fields(self, *_SHARE, "reflected", "sharp", "darkest")
        check_fields(self, "at least 1", lambda x: 1 <= x < math.inf, "reflected_at_most")


@dataclass(frozen=True)
class EntropyConfig:
    """The prior that paint comes in few colours, see joint/albedo_entropy.py."""

    # points whose colours are compared, at most, >= 1
    points: int = 3000
    # points below which nothing is compared, >= 1
    min_points: int = 300
    # observations that each of them has at least, >= 1
    min_views: int = 3
    # linear radiance, >= 0, of the darkest channel of a point; less is noise of 8 bits
    min_color: float = 2e-3
    # share, [0, 1], of the points that are no metal, at least: a few may be metal that was not
    # recognised
    min_paint: float = 0.5
    # log albedo, > 0, whose colours count as one: the side of a cell
    cell: float = 0.15
    # shares, (0, 1), of the light that a sun is tried to send, from every direction
    sun_shares: tuple[float, ...] = (0.35, 0.5, 0.65, 0.8, 0.9, 0.95)
    # nats of entropy, >= 0, that a sun has to save. Suns of half of the light or more save 0.12 to
    # 0.3; of 46 trainings of the stress suite without one, one found a sun, in grainy photographs
    sun_gain: float = 0.08
    # share, (0, 1], of the light of a point, in the mean, that an even sky sends at least
    min_sky: float = 0.1
    # mean cosine, > 0, that counts for a node that hardly reaches any of the surface
    min_reach: float = 0.02
    # of the spherical harmonics that change the log map, >= 1: halves and quarters of the sky
    degree: int = 2
    # log radiance, > 0, by which each harmonic is changed, both ways, one after the other
    steps: tuple[float, ...] = (0.5, 0.25, 0.12, 0.06)
    # passes over all harmonics with each step, >= 1
    sweeps: int = 2
    # nats of entropy, >= 0, that a change has to save: 15 for all of the points
    min_gain: float = 0.005
    # observations of a point that its albedo is averaged over once the light is known, >= 1
    albedo_views: int = 2
    # bounds of a diffuse albedo, in [0, 1]: coal and snow
    albedo: tuple[float, float] = (0.01, 0.95)
    # steps, >= 1, in which the materials learn the albedos under a map that was changed
    teaching_steps: int = 60
    # weight, > 0, of their loss, against the epsilon of Adam; no other was tried
    teaching_weight: float = 0.1

    def __post_init__(self) -> None:
        counts = ("points", "min_points", "min_views", "degree", "sweeps", "albedo_views")
        check_fields(self, *_WHOLE, *counts, "teaching_steps")
        check_fields(self, *_NOT_BELOW, "min_color", "sun_gain", "min_gain")
        check_fields(self, *_FROM_ZERO, "min_paint")
        check_fields(self, *_SHARE, "min_sky")
        check_fields(self, *_ABOVE, "cell", "min_reach", "teaching_weight")
        check_fields(self, *_SHARES, "sun_shares")
        wanted = "numbers above 0"
        check_fields(self, wanted, lambda x: all(0 < v < math.inf for v in x), "steps")
        check_fields(self, *_RANGE, "albedo")


@dataclass(frozen=True)
class TrialConfig:
    """Short rounds of Newton from which the joint solve starts, see joint/initialise.py."""

    # points of a round, >= 1. Of a third of them residuals scatter more than they differ
    points: int = 300
    # Newton steps of a round, >= 1; after three, from no map, too glossy still fits better than
    # right
    steps: int = 6
    # medians of roughness, (0, 1), that are tried beside the present one
    roughness: tuple[float, ...] = (0.25, 0.7)
    # share, (0, 1], of the lowest residual so far that another roughness must not exceed
    better: float = 0.9
    # times the others' residual, > 0, that metal everywhere must not exceed for all to be metal:
    # 0.6 to 1.1 where all is, 1.2 and more where some or nothing is, unless grain, fur or mixed
    # lights leave much to either. Most points have to look like metal then too, see majority
    only_metal: float = 1.15
    # median of roughness, (0, 1], from which metal looks like paint and does not count there
    like_paint: float = 0.5
    # share, (0, 1], of the others' residual that it must not exceed to start from its metals
    all_metal: float = 0.8
    # the same, (0, 1], where most is found to be metal under its map. Of objects all of metal 0.67
    # to 0.93 is; of dielectrics hardly ever as much
    mostly_metal: float = 0.95
    # share, [0, 1], of the points that are most of them: look like metal for all to be metal, and
    # for mostly_metal. Under a map for metal 0.9 do where all is, 0.34 at most elsewhere
    majority: float = 0.5

    def __post_init__(self) -> None:
        check_fields(self, *_WHOLE, "points", "steps")
        wanted = "numbers in (0, 1)"
        check_fields(self, wanted, lambda x: all(0 < v < 1 for v in x), "roughness")
        check_fields(self, *_SHARE, "better", "all_metal", "mostly_metal", "like_paint")
        check_fields(self, *_FROM_ZERO, "majority")
        check_fields(self, *_ABOVE, "only_metal")

    @property
    def rounds(self) -> int:
        """Rounds of Newton in all trials, at most."""
        return 2 * (len(self.roughness) + 2)


@dataclass(frozen=True)
class AdamConfig:
    """Rounds of Adam on map, materials and normals, see joint/stage.py."""

    # learning rates at the end of a round over those at its begin, (0, 1]
    decay: float = 0.1
    # learning rate of the map after a Newton step, times JointConfig.lr_map, >= 0. Light is then
    # better than what Adam would make of it while the albedo follows
    map_after_newton: float = 0.1
    # learning rate of the views' gains after a Newton step, times lr_networks, >= 0; 0: they stay
    gains_after_newton: float = 0.0
    # passes, >= 0, that smooth the gradient of the sdf: fewer than where geometry forms
    sdf_passes: int = 2
    # weight, >= 0, of the squared distance, in voxels, between the surface and its points
    surface: float = 3e-3
    # voxels, > 0: standard deviation of where materials are compared, for their smoothness
    beside: float = 2.0

    def __post_init__(self) -> None:
        check_fields(self, *_SHARE, "decay")
        after = ("map_after_newton", "gains_after_newton")
        check_fields(self, *_NOT_BELOW, *after, "sdf_passes", "surface")
        check_fields(self, *_ABOVE, "beside")


@dataclass(frozen=True)
class JointConfig:
    """The stage that solves for one map, the materials and normals, see joint/stage.py."""

    iterations: int = 700  # Adam steps in all rounds, >= 1; fewer when time runs out
    share: float = 0.4  # of the time budget, (0, 1]
    rays: int = 4096  # observations per step, >= views
    views: int = 4  # observations of a point per step, >= 1
    rounds: int = 4  # of Newton steps on the map and then of Adam, >= 1
    points: int = 20000  # on the surface, >= 1
    tracing: int = 2  # visibility rays per point and direction, >= 1
    colors: bool = True  # whether the light minimises the entropy of albedo, see entropy
    # whether all is metal, as dark as it looks, and the map neutral; None: trials decide
    only_metal: bool | None = None
    lr_features: float = 0.03  # at the begin of a round; all rates > 0
    # at the begin of a round: of the materials' head and the views' gains
    lr_networks: float = 3e-3
    lr_map: float = 0.05  # of the log map
    lr_sdf: float = 0.04  # of the surface, voxels per step, >= 0; 0: it stays
    # weight of the change of the albedo near each point, see AdamConfig.beside; all weights >= 0
    albedo_smoothness: float = 0.005
    # weight of the change of the roughness there
    roughness_smoothness: float = 0.02
    # weight of the cross entropy of metallic and the metal decision
    metallic: float = 0.01
    newton_steps: int = 3  # at the begin of a round, >= 0
    newton_points: int = 4000  # of the points, >= 1
    newton_views: int = 8  # observations of each, >= 2
    newton_roughness: float = 0.1  # standard deviation that roughness follows the map with; 0: none
    newton_smooth: float = 1e-7  # Laplacian on the log map against the mean squared residual, > 0
    # which points of the surface are traced
    surface: SurfaceConfig = field(default_factory=SurfaceConfig)
    # what a Newton step on the map weighs and how far it may go
    newton: NewtonConfig = field(default_factory=NewtonConfig)
    # how points are decided to be metal
    metal: MetalConfig = field(default_factory=MetalConfig)
    # how points are decided to mirror the map
    mirror: MirrorConfig = field(default_factory=MirrorConfig)
    # the prior on few colours, where colors is set
    entropy: EntropyConfig = field(default_factory=EntropyConfig)
    # hypothesis trials, from which the solve starts
    trials: TrialConfig = field(default_factory=TrialConfig)
    # rates and weights of the rounds of Adam
    adam: AdamConfig = field(default_factory=AdamConfig)

    def __post_init__(self) -> None:
        counts = ("iterations", "views", "rounds", "points", "tracing", "newton_points")
        check_fields(self, *_WHOLE, *counts)
        check_fields(self, *_SHARE, "share")
        check_fields(self, "at least views", lambda x: x >= self.views, "rays")
        check_fields(self, *_ABOVE, "lr_features", "lr_networks", "lr_map", "newton_smooth")
        weights = ("albedo_smoothness", "roughness_smoothness", "metallic")
        check_fields(self, *_NOT_BELOW, *weights, "lr_sdf", "newton_steps", "newton_roughness")
        check_fields(self, "at least 2", lambda x: x >= 2, "newton_views")
