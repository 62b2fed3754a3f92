"""What the test views of a data set should look like."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from univoxel import metrics
from univoxel.color import linear_to_srgb
from univoxel.data import Photos, Truth, load_points, load_relit, load_truth, relight_maps
from univoxel.data.base import decode
from univoxel.data.maps import read_map
from univoxel.envmap import EnvMap
from univoxel.errors import DataError, UserError
from univoxel.names import Behind


@dataclass(frozen=True)
class SceneTruth:
    """What a data set knows beside its views, as far as it does."""

    relit: dict[str, tuple[Tensor, Tensor]]  # stored colour and alpha of the test views, by map
    maps: dict[str, EnvMap]
    points: Tensor | None  # [P, 3] of the true surface


@dataclass(frozen=True)
class Expected:
    """What a test view should look like; sRGB on black, but for the photograph."""

    photo: Tensor  # [H, W, 3]
    albedo: Tensor | None  # [H, W, 3]
    relit: dict[str, Tensor]  # [H, W, 3] by map
    truth: Truth
    behind: float = 0.0  # linear grey that the photograph, and what is compared with it, stands on


def load_scene_truth(photos: Photos) -> SceneTruth:
    """The truth beside the test views.

    Raises:
        DataError: a file cannot be used, or has other pixels than the views.
    """
    relit = _relit_photos(photos)
    points = load_points(photos.folder)
    maps = {name: read_map(path) for name, path in relight_maps(photos.folder).items()}
    return SceneTruth(relit, maps, points)


def expected_view(
    photos: Photos, relit: dict[str, tuple[Tensor, Tensor]], view: int, background: Behind = "black"
) -> Expected:
    """The truth of one test view.

    Args:
        relit: as of `SceneTruth`.
        background: what the photograph is composited on.

    Raises:
        DataError: a file cannot be used, or has other pixels than the views.
    """
    truth = view_truth(photos, view)
    color, alpha = photos.picture(view)
    behind = 1.0 if background == "white" else 0.0
    photo = color * alpha[..., None] + behind * (1 - alpha[..., None])
    return Expected(
        photo=linear_to_srgb(photo),
        albedo=None if truth.albedo is None else metrics.on_black(truth.albedo, alpha),
        relit={
            name: metrics.on_black(*decode(*(photos.cameras.cut(view, x[view]) for x in stored)))
            for name, stored in relit.items()
        },
        truth=truth,
        behind=behind,
    )


def every_nth(photos: Photos, trained: list[str], every: int) -> Photos:
    """The first of every so many photographs, in order of the names of all.

    Args:
        photos: that were kept for tests.
        trained: names of those that were trained on.

    Raises:
        UserError: some were trained on, or none is left.
    """
    if every < 1:
        raise UserError(f"test_every must be at least 1, got {every}", "test_every")
    chosen = sorted([*photos.names, *trained])[::every]
    if seen := sorted(set(chosen) & set(trained)):
        raise UserError(
            f"test_every {every} asks for {len(seen)} photographs that were trained on, such as "
            f"{seen[0]}: novel views are those that training has not seen",
            "test_every",
        )
    return photos.of(torch.tensor([photos.names.index(name) for name in chosen]))


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
