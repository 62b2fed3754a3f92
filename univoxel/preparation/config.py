"""Thresholds, counts and lengths of what happens before the first gradient."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from univoxel.validation import check_fields

_WHOLE = ("at least 1", lambda x: x >= 1)
_ABOVE = ("above 0", lambda x: 0 < x < math.inf)
_NOT_BELOW = ("at least 0", lambda x: 0 <= x < math.inf)
_SHARE = ("in [0, 1]", lambda x: 0 <= x <= 1)
_RANGE = ("two numbers, at least 0 and rising", lambda x: len(x) == 2 and 0 <= x[0] < x[1])


@dataclass(frozen=True)
class MaskConfig:
    """Whether masks end where the object does, see preparation/masks.py."""

    # photographs that are looked at, at most, >= 1: the excess is a mean over them
    views: int = 32
    # share of a picture's larger side, in [0, 1], up to which an excess is looked for: wider masks
    # stay as they are
    reach_share: float = 0.015
    # pixels up to which an excess is looked for at least, >= 1, in small pictures
    reach_pixels: int = 6
    # pixels further in, from and to, >= 0, whose colour change an outline is compared with
    comparison: tuple[int, int] = (3, 5)
    # colour change at an outline over that at the masks' edge, and over that further in, > 0: less
    # is the object's pattern
    contrast: float = 1.5
    # pixels outside of the masks, from and to, >= 0, that tell whether they repeat the
    # colour of the edge
    ring: tuple[float, float] = (1.0, 4.0)
    # colour change away from the edge over change along it, > 0, below which the edge's colours are
    # repeated outside, as pictures for blending do: those show no surroundings
    repeated: float = 0.5
    # share of the surroundings that have one colour, in [0, 1], above which they are cut away
    one_color: float = 0.9
    # pixels at a depth, >= 1, below which their mean is noise and is left out
    min_pixels: int = 50

    def __post_init__(self) -> None:
        check_fields(self, *_WHOLE, "views", "reach_pixels", "min_pixels")
        check_fields(self, *_SHARE, "reach_share", "one_color")
        check_fields(self, *_RANGE, "comparison", "ring")
        check_fields(self, *_ABOVE, "contrast", "repeated")


@dataclass(frozen=True)
class HullConfig:
    """The visual hull and the box around it, see preparation/hull.py."""

    # the half of the first box over what the widest view shows at its distance, > 0
    first_box: float = 1.2
    # nodes, >= 8, of the grid that finds the box: a node is a 64th of the box
    box_nodes: int = 64**3
    # grids in a row, >= 1, each around what the one before found, and so finer
    box_rounds: int = 2
    # share of the box's diagonal, >= 0, left free around the hull
    margin: float = 0.03
    # nodes, > 0, at which the hull is evaluated, about; finer grids are interpolated, for time
    nodes: float = 1e6
    # share of the views, in [0, 1], that have to carve a node where masks are doubted: one in ten
    # may lack a part, hardly ever the same part. Two views at least
    doubted_votes: float = 0.07
    # share of the views, in [0, 1], that have to see a node where masks are doubted. Orbits have
    # the whole object in nearly all of their pictures
    doubted_seen: float = 0.25
    # half the width of what a doubted mask lacks or shows too much, in pixels, >= 0: narrower
    # pieces are its jagged edge
    rough_pixels: float = 1.5
    # the same as a share of a picture's larger side, in [0, 1]; the larger of both counts
    rough_share: float = 0.01

    def __post_init__(self) -> None:
        check_fields(self, "at least 8", lambda x: x >= 8, "box_nodes")
        check_fields(self, *_WHOLE, "box_rounds")
        check_fields(self, *_ABOVE, "first_box", "nodes")
        check_fields(self, *_NOT_BELOW, "margin", "rough_pixels")
        check_fields(self, *_SHARE, "doubted_votes", "doubted_seen", "rough_share")


@dataclass(frozen=True)
class OutlineConfig:
    """Where edges of rough masks are moved to, see preparation/outlines.py."""

    # share of a picture's larger side, in (0, 1], by which edges are moved at most
    most: float = 0.04
    # how many times as far, > 0, edges are moved at most as what is not doubted of the masks
    # contradicts itself by: of one edge in twenty that is more
    further: float = 2.0
    # pixels, > 0, by which they may be moved at least
    least: float = 2.0
    # pixels, > 0, beyond what a mask may be off by, in which colours of the object and of what is
    # around are taken
    samples_within: float = 6.0
    # how many times so far, > 0, a pixel may be from the nearest of these: others say nothing
    known_within: float = 2.0
    # colours of the object, >= 1, that a pixel is compared with, the nearest ones: it has patterns
    object_samples: int = 200
    # the same of what is around
    other_samples: int = 24
    # pixels that a mask may be off by, > 0, for each pixel between the colours that are taken: of
    # a wide band fewer are enough, for time
    spacing: float = 3.0
    # sRGB, > 0, that colours of one thing differ by
    noise: float = 0.06
    # how much colours count that tell clearly, > 0
    colors: float = 4.0
    # how much the mask counts, > 0
    given: float = 0.5
    # how much a neighbour of the same colour counts, >= 0
    smooth: float = 3.0
    # how many times steeper the edge is made than the equations for it leave it, >= 1: they draw
    # it out
    steeper: float = 3.0
    # share, in (0, 1], of what masks contradicted one another by, that has to be left at most once
    # edges are moved; of more, something else is wrong, and the edges go back. Jagged masks of the
    # stress suite keep less than 0.3, those of a real head kept 0.9
    kept: float = 0.5

    def __post_init__(self) -> None:
        check_fields(self, "in (0, 1]", lambda x: 0 < x <= 1, "most", "kept")
        check_fields(self, *_WHOLE, "object_samples", "other_samples")
        check_fields(self, *_ABOVE, "further", "least", "samples_within", "known_within")
        check_fields(self, *_ABOVE, "spacing", "noise", "colors", "given")
        check_fields(self, *_NOT_BELOW, "smooth")
        check_fields(self, "at least 1", lambda x: 1 <= x < math.inf, "steeper")


@dataclass(frozen=True)
class MatchesConfig:
    """Cameras against points found again in neighbouring views, see preparation/matches.py."""

    # pairs of neighbouring photographs that are compared, at most, >= 1: a second or two for each
    # four of them
    pairs: int = 16
    # pixels, >= 16, along the longer side of what is searched: larger photographs are shrunk, for
    # time
    longest: int = 640
    # pixels, >= 0, along the longer side up to which they are searched at twice their size
    small: int = 320
    # radii of a keypoint, >= 0, that it lies inside of the silhouette: outlines move over a surface
    clear: float = 2.0
    # difference of the best match over that of the second best, in (0, 1]: above it, it is a guess
    ratio: float = 0.75
    # matches of a pair, >= 9, that a fundamental matrix has to explain together: eight make one
    fitted: int = 16
    # pixels, > 0, that a match may be off by what that matrix says
    residual: float = 1.0
    # matrices that are tried, >= 1
    trials: int = 200
    # matches in all, >= 1, below which nothing is known: plain objects
    min_matches: int = 60
    # pixels, > 0, of the median match, up to which cameras can be right: those of structure from
    # motion are off by 0.2 to 0.8, those that are off by more are worth refining
    max_distance: float = 1.0
    # how many times further, > 0, silhouettes contradict one another where masks are to blame:
    # cameras that are off make both large, the contradiction up to twice as much as the distance
    doubt: float = 4.0

    def __post_init__(self) -> None:
        check_fields(self, *_WHOLE, "pairs", "trials", "min_matches")
        check_fields(self, "at least 16", lambda x: x >= 16, "longest")
        check_fields(self, "at least 9", lambda x: x >= 9, "fitted")
        check_fields(self, *_NOT_BELOW, "small", "clear")
        check_fields(self, "in (0, 1]", lambda x: 0 < x <= 1, "ratio")
        check_fields(self, *_ABOVE, "residual", "max_distance", "doubt")


@dataclass(frozen=True)
class RegistrationConfig:
    """Cameras against silhouettes, see preparation/registration.py."""

    # pixels to the silhouette, negative inside and rising, that count as its edge
    edge: tuple[float, float] = (-1.6, -0.5)
    # points along a ray, >= 2, where silhouettes are looked up; twice, the second time closer
    ray_samples: int = 48
    # rays through edges, >= 1, that the contradiction is measured with
    test_rays: int = 1000
    # share of these rays, in [0, 1], that miss by less than the contradiction
    quantile: float = 0.95
    # pixels, > -inf, above which cameras are refined. Exact ones contradict by -0.3 or less:
    # measured -0.7 to -0.4 in 19 of 20 scenes
    max_contradiction: float = 0.25
    # steps of Adam, >= 1
    steps: int = 150
    # learning rate at begin and end, radians and radii of the object, > 0
    lr: tuple[float, float] = (5e-3, 2.5e-4)
    # rays of a step, >= 1
    rays: int = 256
    # silhouettes that the rays of a step are held against, >= 1
    views: int = 32

    def __post_init__(self) -> None:
        check_fields(self, "two numbers, rising", lambda x: len(x) == 2 and x[0] < x[1], "edge")
        check_fields(self, "at least 2", lambda x: x >= 2, "ray_samples")
        check_fields(self, *_WHOLE, "test_rays", "steps", "rays", "views")
        check_fields(self, *_SHARE, "quantile")
        check_fields(self, "a finite number", lambda x: math.isfinite(x), "max_contradiction")
        check_fields(
            self,
            "two numbers above 0",
            lambda x: len(x) == 2 and 0 < min(x) <= max(x) < math.inf,
            "lr",
        )


@dataclass(frozen=True)
class ExposureConfig:
    """How photographs' exposures differ, see preparation/exposures.py."""

    # points of the surface, >= 1, whose colours are compared
    points: int = 6000
    # sRGB, in [0, 1]; darker colours are left out: rounding to 8 bits and reflections are too
    # large a part of them
    dark: float = 0.1
    # natural log, > 0; the scale of the Cauchy weights: what is seen of one point may differ by
    # this before it counts for less
    cauchy: float = 0.07
    # rounds of iteratively reweighted least squares, >= 1
    rounds: int = 20
    # points that speak for a gain of 1, > 0: of a photograph that shares none with others
    prior: float = 1e-3
    # share of the object's pixels, in [0, 1], that are clipped, above which it is said
    much_clipped: float = 0.03
    # stops, root mean square, >= 0, above which exposures differ. Where they are alike, reflections
    # and a hull that is too large look like 0.01 to 0.16 stops. Metal or light that changes looks
    # like 0.25: gains do no harm there
    min_stops: float = 0.2

    def __post_init__(self) -> None:
        check_fields(self, *_WHOLE, "points", "rounds")
        check_fields(self, *_SHARE, "dark", "much_clipped")
        check_fields(self, *_ABOVE, "cauchy", "prior")
        check_fields(self, *_NOT_BELOW, "min_stops")


@dataclass(frozen=True)
class CarvingConfig:
    """Concavities that no silhouette shows, see preparation/carving.py."""

    # photographs that are used, at most, >= 1: for time
    views: int = 100
    # seconds that a pixel of the object takes, about, on two cores, > 0
    pixel_seconds: float = 6e-6
    # depths along a ray, >= 2, a voxel apart: deeper concavities are opened as far as this
    depths: int = 48
    # views that a view's depths come from, >= 1; as many again check them
    neighbours: int = 8
    # of them, views that agree best and count, >= 1: others are occluded
    best: int = 4
    # share, in [0, 1], of a logarithmic curve in the colours that are compared. Cloth inside of a
    # shoe shows its pattern in few steps of 8 bits: dark colours are taken further apart
    log_share: float = 2 / 3
    # steepness of that curve, > 0: how many times further apart black is taken than with log(1 + x)
    log_steepness: float = 40.0
    # colour difference, >= 0, that a step of one depth between neighbouring pixels costs
    slope: float = 0.0033
    # colour difference, >= 0, that a larger step costs, at least slope
    jump: float = 0.0133
    # voxels behind a view's depth, >= 0, up to which it has a say on nodes
    behind: float = 2.5
    # share of the views with a say, in [0, 1], above which a node is carved that they see through
    agree: float = 0.6
    # share of all views, in [0, 1], above which it is: fewer may see a lamp in something glossy
    least: float = 0.2
    # share of a pixel's disagreement on the hull, in [0, 1], by which the depth has to be better
    better: float = 0.1
    # colour difference, >= 0, by which it has to be better at least: a third of a step of 8 bits
    # where it is bright
    visible: float = 0.0007
    # share of the pixels that see through a node, in [0, 1], above which the depth has to be better
    enough: float = 0.25
    # voxels, > 0, around a node within which that share is taken
    around: float = 2.0
    # share of the hull's nodes, in [0, 1], that a concavity has at least: smaller ones are left to
    # training
    piece: float = 5e-4
    # rounds, >= 1, in which nodes are put back whose absence uncovers a silhouette
    rounds: int = 3

    def __post_init__(self) -> None:
        check_fields(self, *_WHOLE, "views", "neighbours", "best", "rounds")
        check_fields(self, "at least 2", lambda x: x >= 2, "depths")
        check_fields(self, *_ABOVE, "pixel_seconds", "log_steepness", "around")
        check_fields(self, *_NOT_BELOW, "slope", "behind", "visible")
        check_fields(self, "at least slope", lambda x: self.slope <= x < math.inf, "jump")
        shares = ("log_share", "agree", "least", "better", "enough", "piece")
        check_fields(self, *_SHARE, *shares)


@dataclass(frozen=True)
class LightFrameConfig:
    """Whether the light turned with the camera, see preparation/light_frame.py."""

    # points of the surface, >= 1, whose colours are compared
    points: int = 1500
    # sRGB, in [0, 1]; darker colours are left out: rounding to 8 bits is too large a part of them
    dark: float = 0.05
    # natural log, > 0; the scale of the Cauchy cost of a colour that is not explained
    cauchy: float = 0.1
    # rounds of iteratively reweighted least squares, >= 1
    rounds: int = 6
    # how many times as much a light that turns has to explain as one that stands still, > 0. Of
    # four rendered scenes under a still light it was 0.1 to 0.2 times, of a bronze head on a
    # turntable 1.8 times
    better: float = 1.0
    # share of the cost, in [0, 1], that it has to explain at least, over `better`
    least: float = 0.03
    # `better` where the surroundings do not say whether they stood still. Of objects on rings of
    # cameras it was up to 3 under a still light, and 60 under one that turned; of a shiny ball, 3.2
    better_alone: float = 3.0
    # `least` there, in [0, 1]: times `better_alone` it is above the 14 % of the cost that a light
    # taken to turn explained under a still one, and below the 30 and 70 % under one that turned
    least_alone: float = 0.07
    # pixels, >= 8, along the longer side of the pictures whose surroundings are compared
    small: int = 128
    # of those pixels, >= 1, by which a camera that stands still may wobble, or be turned a little
    wobble: int = 3
    # by which surroundings are shifted, >= 1, to see whether that fits better: less than a camera
    # sees them shift that goes some 5 degrees around the object
    shift: int = 10
    # correlation, in [0, 1], that surroundings which stood still have at least
    alike: float = 0.85
    # correlation, in [0, 1], of a picture with itself shifted, above which it is too plain to tell
    plain: float = 0.95

    def __post_init__(self) -> None:
        check_fields(self, *_WHOLE, "points", "rounds", "wobble", "shift")
        check_fields(self, "at least 8", lambda x: x >= 8, "small")
        check_fields(self, *_SHARE, "dark", "least", "least_alone", "alike", "plain")
        check_fields(self, *_ABOVE, "cauchy", "better", "better_alone")


@dataclass(frozen=True)
class PinnedConfig:
    """Where training leaves the visual hull as it is, see preparation/pinned.py."""

    # points of the hull that are looked at, >= 0; 0: nothing is pinned
    points: int = 8000
    # cosine of normal and direction to the camera, in [0, 1], below which sightings are left out
    min_cosine: float = 0.25
    # sightings that a point has at least, >= 1
    min_views: int = 8
    # voxels, > 0, off the surface at which mirrored rays start
    off_surface: float = 2.0
    # rows, >= 1, and twice as many columns, of the table of what directions send
    rows: int = 24
    # sightings, > 0, that have to tell what a direction sends
    least: float = 3.0
    # share, in [0, 1], of a neighbourhood's sightings that have to be told so
    share: float = 0.3
    # classes of normals, >= 1, spread over the sphere
    classes: int = 64
    # degrees, in [0, 180], by which normals differ that are compared with one another
    turn: float = 20.0
    # points, >= 1, of a neighbourhood, over which sums are taken
    neighbours: int = 32
    # voxels, > 0, that count in the search for neighbours as much as `bend`
    near: float = 3.0
    # difference of unit normals, > 0
    bend: float = 0.5
    # rounds, >= 1, in which points leave the table
    rounds: int = 8
    # root mean square, in sRGB, >= 0, by which a neighbourhood changes from view to view at least
    change: float = 0.18
    # times, >= 0, that points which stay in the table show its changes
    gain: float = 0.6
    # share of all points, in [0, 1], that the table is made of at least: some agree by chance
    least_share: float = 0.05
    # correlation, in [0, 1], of their changes with those of the table
    correlation: float = 0.5
    # change, >= 0, of points of the table from which regions grow that are pinned. Half of
    # the chrome of a scene changed by 0.30 to 0.43, half of its rough copper by 0.18 to 0.31: that
    # is trained better than it is pinned
    strong_change: float = 0.33
    # change, >= 0, of points that they take in
    weak_change: float = 0.26
    # correlation, in [0, 1], of such points
    weak_correlation: float = 0.2
    # voxels, > 0, around the surface within which nodes stay
    band: float = 3.0

    def __post_init__(self) -> None:
        check_fields(self, *_WHOLE, "min_views", "rows", "classes", "neighbours", "rounds")
        check_fields(self, *_NOT_BELOW, "points", "gain")
        check_fields(self, *_NOT_BELOW, "change", "strong_change", "weak_change")
        check_fields(
            self, *_SHARE, "min_cosine", "share", "least_share", "correlation", "weak_correlation"
        )
        check_fields(self, *_ABOVE, "off_surface", "least", "near", "bend", "band")
        check_fields(self, "in [0, 180]", lambda x: 0 <= x <= 180, "turn")


@dataclass(frozen=True)
class PreparationConfig:
    """What happens before the first gradient, in order."""

    # whether masks are too wide
    masks: MaskConfig = field(default_factory=MaskConfig)
    # the visual hull, and the box of the grid
    hull: HullConfig = field(default_factory=HullConfig)
    # whether cameras or masks are wrong, by points that photographs share
    matches: MatchesConfig = field(default_factory=MatchesConfig)
    # where edges of rough masks are moved to
    outlines: OutlineConfig = field(default_factory=OutlineConfig)
    # whether cameras are off, and how they are moved
    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    # whether exposures differ, and by what gains
    exposures: ExposureConfig = field(default_factory=ExposureConfig)
    # whether the light turned with the camera
    light_frame: LightFrameConfig = field(default_factory=LightFrameConfig)
    # where training leaves the hull as it is
    pinned: PinnedConfig = field(default_factory=PinnedConfig)
    # where the hull is opened
    carving: CarvingConfig = field(default_factory=CarvingConfig)


MASKS, HULL, REGISTRATION = MaskConfig(), HullConfig(), RegistrationConfig()
MATCHES, OUTLINES = MatchesConfig(), OutlineConfig()
EXPOSURES, CARVING, PINNED = ExposureConfig(), CarvingConfig(), PinnedConfig()
LIGHT_FRAME = LightFrameConfig()
PREPARATION = PreparationConfig()
