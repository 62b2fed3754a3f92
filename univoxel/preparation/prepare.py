"""The preparation of masks, cameras and photographs, in order."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from univoxel.camera import Cameras, PoseSteps
from univoxel.color import CLIPPED, linear_to_srgb
from univoxel.config import StageConfig, TrainConfig
from univoxel.core import log
from univoxel.core.choices import Varying
from univoxel.data import Photos
from univoxel.errors import DataError, UserError
from univoxel.fields.grid import GridShape, fit_grid
from univoxel.lights.base import LocalLightConfig
from univoxel.preparation.carving import carve_within_time
from univoxel.preparation.hull import observe_hull, visual_hull
from univoxel.preparation.hull_constraint import PinnedHull, pinned_hull
from univoxel.preparation.light_frame import (
    VARIED,
    LightFrame,
    light_frame_of,
    varied_light,
)
from univoxel.preparation.masks import fitted_masks
from univoxel.preparation.object_shape import ObjectShape, signed_distance
from univoxel.preparation.pose_refinement import (
    choose_masks_or_poses,
    masks_or_poses_as_told,
    registered_poses,
)
from univoxel.preparation.rough_masks import doubt_masks
from univoxel.scene import Scene

# Points of the surface whose colours are compared
POINTS = 6000
# sRGB; darker colours are left out: rounding to 8 bits and reflections are too large a part of
# them
DARK = 0.1
# Natural log; the scale of the Cauchy weights: what is seen of one point may differ by this
# before it counts for less
CAUCHY = 0.07
# Rounds of iteratively reweighted least squares
ROUNDS = 20
# Points that speak for a gain of 1: of a photograph that shares none with others
PRIOR = 1e-3
# Share of the object's pixels that are clipped, above which it is said
MUCH_CLIPPED = 0.03
# `contradictions_left` at most where exposures differ: 0.4 to 0.91 are then. Where they are alike
# 0.97 to 1.25 are, metals and flashes among them; where the light itself varies, 0.86 to 1.01
MOST_LEFT = 0.93
# Stops, root mean square, below which exposures are alike: a hull that is too large looks like 0.03
MIN_STOPS = 0.1
# Points of either half of the surface that a photograph has to show to be compared
COMMON = 20


@dataclass(frozen=True)
class Brightness:
    """How bright P points of a surface are in V photographs."""

    position: Tensor  # [P, 3] world
    log_color: Tensor  # [P, V] natural log of the linear mean of the channels
    observed: Tensor  # [P, V] 1 where a photograph shows a point, neither dark nor clipped; else 0

    def at(self, which: Tensor) -> Brightness:
        """Of some of the points."""
        return Brightness(*(value[which] for value in vars(self).values()))


@torch.no_grad()
def brightness_of(photos: Photos, sdf: Tensor, grid: GridShape) -> Brightness:
    """That of POINTS points; of none, if the photographs show no surface.

    Args:
        photos: V, their cameras where they are believed to be.
        sdf: [X, Y, Z] world units, such as in the visual hull.
        grid: of the sdf.
    """
    seen = observe_hull(photos, sdf, grid, POINTS)
    if seen is None:
        return Brightness(torch.zeros(0, 3), *torch.zeros(2, 0, len(photos), dtype=torch.double))
    encoded = linear_to_srgb(seen.color)
    usable = (encoded.mean(1) > DARK) & (encoded < CLIPPED).all(1)
    point_and_view = torch.repeat_interleave(seen.offsets.diff())[usable], seen.view[usable]
    log_color, observed = torch.zeros(2, POINTS, len(photos), dtype=torch.double)
    log_color[point_and_view] = seen.color[usable].mean(1).double().log()
    observed[point_and_view] = 1.0
    return Brightness(seen.position, log_color, observed)


def log_gains(seen: Brightness) -> Tensor:
    """The log gains [V], of mean 0, of photographs that agree best on how bright points are.

    log brightness_pv = log gain_v + log albedo_p, in robust least squares: many sightings are of
    something else, where the surface is off, and highlights move.

    Source: Brown and Lowe 2007, "Automatic panoramic image stitching using invariant features", for
    gains from overlaps; Cauchy's weights, iterated, as in robust statistics.
    """
    return _agreed(seen)[0]


def contradictions_left(seen: Brightness) -> float:
    """Of what photographs of one half of the surface contradict each other by: the share that is
    left under gains that the other half told. 1 where there is nothing to compare.

    What metal mirrors changes from photograph to photograph as exposures do, but on one side of the
    object in another way than on the other. The surface is cut in half along each axis in turn.
    """
    if not len(seen.position):
        return 1.0
    costs = torch.zeros(2, dtype=torch.double)  # with the gains, and without
    for place in seen.position.unbind(1):
        upper = place > place.median()
        halves = seen.at(upper), seen.at(~upper)
        shared = torch.stack([half.observed.sum(0) >= COMMON for half in halves]).all(0)
        for told, asked in (halves, halves[::-1]):
            gains = log_gains(told)
            trials = gains, torch.zeros_like(gains)
            costs += torch.stack([_agreed(asked, trial)[1][shared].sum() for trial in trials])
    with_gains, without = costs.tolist()
    return with_gains / without if without else 1.0


def _agreed(seen: Brightness, gains: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Log gains [V] of mean 0 under which photographs agree best, and the mean Cauchy cost [V] of
    each that is left.

    Args:
        gains: [V]; None: they are looked for.
    """
    log_color, observed = seen.log_color, seen.observed
    found = observed.new_zeros(observed.shape[1]) if gains is None else gains
    weight, square = observed, torch.zeros_like(observed)
    for _ in range(ROUNDS):
        share = weight / weight.sum(1, keepdim=True).clamp_min(1e-9)
        if gains is None:
            # The albedos eliminated: a Laplacian of the photographs, tied by the points that they
            # share
            system = torch.diag(weight.sum(0) + PRIOR) - weight.T @ share
            right_side = (weight * (log_color - (share * log_color).sum(1, keepdim=True))).sum(0)
            found = torch.linalg.solve(system, right_side)
            found = found - found.mean()
        albedo = (share * (log_color - found)).sum(1, keepdim=True)
        square = ((log_color - found - albedo) / CAUCHY).square()
        weight = observed / (1 + square)
    return found, (observed * square.log1p()).sum(0) / observed.sum(0).clamp_min(1)


def clipped_share(photos: Photos) -> float:
    """Share of the object's pixels of which a channel is clipped: they were at least so bright.

    Linear photographs have none.
    """
    if photos.color.dtype != torch.uint8:
        return 0.0
    clipped = shown = 0
    for view in range(len(photos)):
        color, alpha = photos.stored(view)
        object_ = alpha > 0.5 * (1 if alpha.is_floating_point() else 255)
        shown += int(object_.sum())
        clipped += int((color[object_] > 255 * CLIPPED).any(1).sum())
    return clipped / max(shown, 1)


def say_clipped(photos: Photos) -> None:
    """Say so where much of the object is clipped."""
    share = clipped_share(photos)
    if share > MUCH_CLIPPED:
        log.info(
            "%.0f %% of the object is overexposed, so detail is lost there. Next time, expose less",
            100 * share,
        )


def varying_and_gains(
    photos: Photos,
    hull: Tensor,
    grid: GridShape,
    varying: Varying,
    look: bool,
) -> tuple[Varying, Tensor | None]:
    """What differs from photograph to photograph, and their log gains [V] where anything does.

    Args:
        photos: V, their cameras where they are believed to be.
        hull: [X, Y, Z] sdf of the visual hull, world units.
        grid: of the hull.
        varying: what is known to differ.
        look: whether to find out if exposures do, where there is nothing known to differ.
    """
    if varying == "none" and not look:
        return varying, None
    seen = brightness_of(photos, hull, grid)
    gains = log_gains(seen).float()
    stops = float(gains.square().mean().sqrt()) / math.log(2)
    if varying == "none":
        left = contradictions_left(seen) if stops >= MIN_STOPS else 1.0
        log.debug("exposures: gains of %.2f stops; %.2f of the differences remain", stops, left)
        if left > MOST_LEFT:
            return varying, None
        varying = "exposure"
        log.info(
            "exposures differ by %.2f stops between photographs, so a gain is learned for each; "
            "varying=none switches this off",
            stops,
            extra={"arguments": ("varying",)},
        )
    return varying, gains


PINNED = "frozen hull"  # a step


def unhurried(step: str, needed: bool = False) -> bool:
    """There is time for every step, and nobody to tell."""
    return True


@dataclass(frozen=True)
class Silhouettes:
    """What masks and cameras say; a run that is resumed needs it too, and it is the same then."""

    photos: Photos  # masks as they are used, cameras as they were given
    distance: Tensor  # [V, H, W] pixels to the silhouette, negative inside and where it is doubted
    box: tuple[Tensor, Tensor]  # corners [3], [3] around the object
    refined: bool  # whether the cameras are refined
    votes: int = 1  # views that have to carve a node of the hull, >= 1
    doubted: Tensor | None = None  # [V, H, W] bool: nothing is learned there; None: nowhere
    edges_given: bool = True  # whether masks are as given, and none of their edges doubted
    shape: ObjectShape | None = None  # told in 3D, where masks are rough; None: they are believed


@dataclass(frozen=True)
class Prepared:
    """What a new scene is built from."""

    silhouettes: Silhouettes
    poses: PoseSteps | None  # steps to cameras whose silhouettes agree; None: they stay
    grid: GridShape  # of the first stage
    hull: Tensor  # [X, Y, Z] sdf of the carved visual hull on the grid, world units
    varying: Varying  # what differs from photograph to photograph
    gains: Tensor | None  # [V] log gains of the exposures; None: all are alike
    frame: LightFrame  # what the light stands still in
    pinned: PinnedHull | None  # where training leaves the hull as it is; None: nowhere


def find_silhouettes(
    photos: Photos, cfg: TrainConfig, begins: Callable[..., bool] = unhurried
) -> Silhouettes:
    """The photographs with the masks that are used, and the box around the object.

    Args:
        begins: told of each step, and whether it is needed; says whether it is to be made. Where it
            is not, masks and cameras are taken as they are.

    Raises:
        DataError: the silhouettes share no volume.
    """
    given = photos
    in_time = begins("masks")
    photos, distance = fitted_masks(given, cfg.masks if in_time else "given")
    try:
        if begins("consistency of masks and cameras"):
            belief = choose_masks_or_poses(photos, distance, cfg.cameras, cfg.masks)
        else:
            belief = masks_or_poses_as_told(photos, distance, cfg.cameras)
        found = None
        if belief.votes > 1 and begins("rough masks"):
            found = doubt_masks(photos, distance, belief)
    except UserError as error:
        raise DataError(f"{cfg.data}: {error}") from None
    # Rough masks that there was no time to repair are no measure of how sharp edges are
    doubted, shape, edges_given = None, None, photos is given and belief.votes == 1
    if found is not None:
        doubted, shape = found.pixels, found.shape
        belief = found.belief  # and `distance` is that of masks with all that is doubted
    believed = belief.box, belief.refined, belief.votes
    return Silhouettes(photos, distance, *believed, doubted, edges_given, shape)


def prepare(
    silhouettes: Silhouettes, cfg: TrainConfig, begins: Callable[..., bool] = unhurried
) -> Prepared:
    """Cameras, carved hull and exposures that training begins with.

    Args:
        cfg: its first stage says how many voxels the hull's grid has.
        begins: as in `find_silhouettes`.
    """
    stage = cfg.stages[0]
    assert isinstance(stage, StageConfig)
    photos, distance, box = silhouettes.photos, silhouettes.distance, silhouettes.box
    grid = fit_grid(*box, round(1e6 * stage.voxels))
    poses = None
    if silhouettes.refined and begins("cameras"):
        poses = registered_poses(distance, photos.cameras, box)
        photos = replace(photos, cameras=poses.corrected(photos.cameras))
    begins("hull", needed=True)
    hull = visual_hull(distance, photos.cameras, grid, silhouettes.votes)
    if silhouettes.shape is not None:
        hull = torch.maximum(hull, signed_distance(silhouettes.shape, grid))
    begins("exposures", needed=True)
    say_clipped(photos)
    known = photos if silhouettes.doubted is None else photos.without(silhouettes.doubted)
    varying, gains = varying_and_gains(known, hull, grid, cfg.scene.varying, cfg.exposures)
    frame = light_frame_of(known, hull, grid, cfg.light_frame, gains)
    # A light for each photograph is one that differs from point to point, in the world
    may_vary = cfg.exposures and isinstance(cfg.scene.light, LocalLightConfig)
    if may_vary and frame == LightFrame() and varied_light(known, hull, grid, gains) > VARIED:
        varying = "light"
        log.info(
            "light differs between photographs, so each gets a light of its own; varying=none "
            "switches this off",
            extra={"arguments": ("varying",)},
        )
    pinned, in_world = None, frame == LightFrame()
    if varying == "none" and in_world and begins(PINNED):
        pinned = find_pinned(silhouettes, photos.cameras, hull, grid)
    carves = cfg.carving_seconds and varying != "light" and in_world
    # A shape that depth was asked for has its concavities
    carves = carves and (silhouettes.shape is None or silhouettes.shape.surface == 0)
    if carves and begins("concavities"):
        seconds = cfg.carving_seconds
        carved = carve_within_time(hull, grid, photos, gains, seconds)
        hull = carved if pinned is None else torch.where(pinned.nodes(hull, grid), hull, carved)
    return Prepared(silhouettes, poses, grid, hull, varying, gains, frame, pinned)


def pinned_in(
    silhouettes: Silhouettes,
    scene: Scene,
    cfg: TrainConfig,
    begins: Callable[..., bool] = unhurried,
) -> PinnedHull | None:
    """What `prepare` pinned, of a scene that continues."""
    stage = cfg.stages[0]
    assert isinstance(stage, StageConfig)
    light = scene.cfg
    if light.varying != "none" or light.turntable is not None or light.flash is not None:
        return None
    if not begins(PINNED):
        return None
    cameras = scene.registered(silhouettes.photos).cameras
    grid = fit_grid(*silhouettes.box, round(1e6 * stage.voxels))
    hull = visual_hull(silhouettes.distance, cameras, grid)
    return find_pinned(silhouettes, cameras, hull, grid)


def find_pinned(
    silhouettes: Silhouettes,
    cameras: Cameras,
    hull: Tensor,
    grid: GridShape,
) -> PinnedHull | None:
    """`pinned_hull`; rough masks give no hull that could be right.

    Args:
        cameras: where they are believed to be.
        hull: [X, Y, Z] sdf of the visual hull on the grid, world units.
    """
    if silhouettes.votes > 1:
        return None
    photos = replace(silhouettes.photos, cameras=cameras)
    return pinned_hull(photos, silhouettes.distance, hull, grid)
