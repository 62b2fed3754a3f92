"""What masks, cameras and photographs say before the first gradient, in order."""

from __future__ import annotations

from dataclasses import dataclass, replace

from torch import Tensor

from univoxel.config import TrainConfig
from univoxel.data import Photos
from univoxel.errors import DataError, UserError
from univoxel.grid import GridShape, fit_grid
from univoxel.lights.turntable import Turntable
from univoxel.names import Varying
from univoxel.poses import PoseSteps
from univoxel.preparation.belief import weighed
from univoxel.preparation.carving import carve_within_time
from univoxel.preparation.exposures import say_clipped, varying_and_gains
from univoxel.preparation.hull import visual_hull
from univoxel.preparation.light_frame import turntable_of
from univoxel.preparation.masks import fitted_masks
from univoxel.preparation.mending import mended
from univoxel.preparation.registration import registered_poses
from univoxel.training.config import StageConfig


@dataclass(frozen=True)
class Silhouettes:
    """What masks and cameras say; a run that is resumed needs it too, and it is the same then."""

    photos: Photos  # masks as they are used, cameras as they were given
    distance: Tensor  # [V, H, W] pixels to the silhouette, negative inside and where it is doubted
    box: tuple[Tensor, Tensor]  # corners [3], [3] around the object
    refined: bool  # whether the cameras are refined
    votes: int = 1  # views that have to carve a node of the hull, >= 1
    doubted: Tensor | None = None  # [V, H, W] bool: nothing is learned there; None: nowhere


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


def find_silhouettes(photos: Photos, cfg: TrainConfig) -> Silhouettes:
    """The photographs with the masks that are used, and the box around the object.

    Raises:
        DataError: the silhouettes share no volume.
    """
    photos, distance = fitted_masks(photos, cfg.masks, cfg.preparation.masks)
    try:
        belief = weighed(photos, distance, cfg.cameras, cfg.masks, cfg.preparation)
    except UserError as error:
        raise DataError(f"{cfg.data}: {error}") from None
    doubted = None
    if belief.votes > 1:
        found = mended(photos, distance, belief, cfg.preparation)
        photos, doubted = found.photos, found.doubted
        distance, belief = found.distance, found.belief
    return Silhouettes(photos, distance, belief.box, belief.refined, belief.votes, doubted)


def prepare(silhouettes: Silhouettes, cfg: TrainConfig) -> Prepared:
    """Cameras, carved hull and exposures that training begins with.

    Args:
        cfg: its first stage says how many voxels the hull's grid has.
    """
    stage = cfg.stages[0]
    assert isinstance(stage, StageConfig)
    constants = cfg.preparation
    photos, distance, box = silhouettes.photos, silhouettes.distance, silhouettes.box
    grid = fit_grid(*box, round(1e6 * stage.voxels))
    poses = None
    if silhouettes.refined:
        poses = registered_poses(distance, photos.cameras, box, constants.registration)
        photos = replace(photos, cameras=poses.corrected(photos.cameras))
    hull = visual_hull(distance, photos.cameras, grid, constants.hull, silhouettes.votes)
    say_clipped(photos, constants.exposures)
    varying, gains = varying_and_gains(
        photos, hull, grid, cfg.scene.varying, cfg.exposures, constants.exposures
    )
    turntable = turntable_of(photos, hull, grid, cfg.light_frame, constants.light_frame)
    if cfg.hollows and varying != "light" and turntable is None:
        seconds = cfg.hollows * 60 * cfg.minutes
        hull = carve_within_time(hull, grid, photos, gains, seconds, constants.carving)
    return Prepared(silhouettes, poses, grid, hull, varying, gains, turntable)
