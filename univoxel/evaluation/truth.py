"""What the test views of a data set should look like."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from univoxel import metrics
from univoxel.data import Photos, Truth, load_points, load_relit, load_truth, relight_maps
from univoxel.data.base import decode
from univoxel.data.maps import read_map
from univoxel.envmap import EnvMap
from univoxel.errors import DataError


@dataclass(frozen=True)
class SceneTruth:
    """What a data set knows beside its views, as far as it does."""

    relit: dict[str, tuple[Tensor, Tensor]]  # stored colour and alpha of the test views, by map
    maps: dict[str, EnvMap]
    points: Tensor | None  # [P, 3] of the true surface


@dataclass(frozen=True)
class Expected:
    """What a test view should look like; sRGB on black."""

    photo: Tensor  # [H, W, 3]
    albedo: Tensor | None  # [H, W, 3]
    relit: dict[str, Tensor]  # [H, W, 3] by map
    truth: Truth


def load_scene_truth(photos: Photos) -> SceneTruth:
    """The truth beside the test views.

    Raises:
        DataError: a file cannot be used, or has other pixels than the views.
    """
    relit = _relit_photos(photos)
    points = load_points(photos.folder)
    maps = {name: read_map(path) for name, path in relight_maps(photos.folder).items()}
    return SceneTruth(relit, maps, points)


def expected_view(photos: Photos, relit: dict[str, tuple[Tensor, Tensor]], view: int) -> Expected:
    """The truth of one test view.

    Args:
        relit: as of `SceneTruth`.

    Raises:
        DataError: a file cannot be used, or has other pixels than the views.
    """
    truth = view_truth(photos, view)
    color, alpha = photos.picture(view)
    return Expected(
        photo=metrics.on_black(color, alpha),
        albedo=None if truth.albedo is None else metrics.on_black(truth.albedo, alpha),
        relit={
            name: metrics.on_black(*decode(*(photos.cameras.cut(view, x[view]) for x in stored)))
            for name, stored in relit.items()
        },
        truth=truth,
    )


def view_truth(photos: Photos, view: int) -> Truth:
    """The layers of truth of one test view, as far as there are any."""
    truth = load_truth(photos, view)
    if truth.mask is not None:
        _check_size(photos, view, truth.mask, f"truth of {photos.names[view]}")
    return truth


def _relit_photos(photos: Photos) -> dict[str, tuple[Tensor, Tensor]]:
    """Stored colour and alpha of the test views, by map."""
    return {name: load_relit(photos, name) for name in relight_maps(photos.folder)}


def _check_size(photos: Photos, view: int, picture: Tensor, what: str) -> None:
    width, height = photos.cameras.size(view)
    if picture.shape != (height, width):
        raise DataError(
            f"{photos.folder}: expected {what} to have {width}x{height} pixels like the test "
            f"view, got {picture.shape[1]}x{picture.shape[0]}"
        )
