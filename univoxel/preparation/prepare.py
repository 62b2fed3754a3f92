"""What masks, cameras and photographs say before the first gradient, in order."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from univoxel.camera import Cameras
from univoxel.config import StageConfig, TrainConfig
from univoxel.data import Photos
from univoxel.errors import DataError, UserError
from univoxel.grid import GridShape, fit_grid
from univoxel.lights.turntable import Turntable
from univoxel.names import Varying
from univoxel.poses import PoseSteps
from univoxel.preparation.belief import unweighed, weighed
from univoxel.preparation.carving import carve_within_time
from univoxel.preparation.exposures import say_clipped, varying_and_gains
from univoxel.preparation.hull import visual_hull
from univoxel.preparation.light_frame import turntable_of
from univoxel.preparation.masks import fitted_masks
from univoxel.preparation.object_shape import ObjectShape, signed_distance
from univoxel.preparation.pinned import PinnedHull, pinned_hull
from univoxel.preparation.registration import registered_poses
from univoxel.preparation.rough_masks import doubt_masks
from univoxel.preparation.strays import say_strays
from univoxel.scene import Scene

PINNED = "hull that stays"  # a step


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
    turntable: Turntable | None  # about which the light turns; None: it stands still
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
    if cfg.cameras == "auto":
        say_strays(photos)
    given = photos
    in_time = begins("masks")
    photos, distance = fitted_masks(given, cfg.masks if in_time else "given")
    try:
        if begins("masks against cameras"):
            belief = weighed(photos, distance, cfg.cameras, cfg.masks)
        else:
            belief = unweighed(photos, distance, cfg.cameras)
        found = None
        if belief.votes > 1 and begins("rough masks"):
            found = doubt_masks(photos, belief)
    except UserError as error:
        raise DataError(f"{cfg.data}: {error}") from None
    # Rough masks that there was no time to mend are no measure of how sharp edges are
    doubted, shape, edges_given = None, None, photos is given and belief.votes == 1
    if found is not None:
        doubted, shape = found.pixels, found.shape
        distance, belief = found.distance, found.belief
    believed = belief.box, belief.refined, belief.votes
    return Silhouettes(photos, distance, *believed, doubted, edges_given, shape)


def prepare(
    silhouettes: Silhouettes, cfg: TrainConfig, begins: Callable[..., bool] = unhurried
) -> Prepared:
    """Cameras, carved hull and exposures that training begins with.

    Args:
        cfg: its first stage says how many voxels the hull's grid has.
        begins: as of `find_silhouettes`.
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
    varying, gains = varying_and_gains(photos, hull, grid, cfg.scene.varying, cfg.exposures)
    turntable = turntable_of(photos, hull, grid, cfg.light_frame)
    pinned = None
    if varying == "none" and turntable is None and begins(PINNED):
        pinned = find_pinned(silhouettes, photos.cameras, hull, grid)
    carves = cfg.carving_seconds and varying != "light" and turntable is None
    carves = carves and silhouettes.shape is None  # which has its concavities
    if carves and begins("concavities"):
        seconds = cfg.carving_seconds
        carved = carve_within_time(hull, grid, photos, gains, seconds)
        hull = carved if pinned is None else torch.where(pinned.nodes(hull, grid), hull, carved)
    return Prepared(silhouettes, poses, grid, hull, varying, gains, turntable, pinned)


def pinned_in(
    silhouettes: Silhouettes,
    scene: Scene,
    cfg: TrainConfig,
    begins: Callable[..., bool] = unhurried,
) -> PinnedHull | None:
    """What `prepare` pinned, of a scene that goes on."""
    stage = cfg.stages[0]
    assert isinstance(stage, StageConfig)
    if scene.cfg.varying != "none" or scene.cfg.turntable is not None:
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
