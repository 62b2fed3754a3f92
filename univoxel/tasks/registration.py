"""Whether photographs, masks and cameras agree; what is put right where they do not."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from univoxel.camera import Cameras
from univoxel.config import CamerasFrom, MasksFrom
from univoxel.data import Photos
from univoxel.fields.hull import estimate_bounds, mask_distances
from univoxel.fields.outlines import taken_in, too_wide
from univoxel.fields.registration import align, contradiction
from univoxel.poses import PoseSteps

AGREEING = 0.25  # pixels that silhouettes may contradict one another by: -0.4 where all is exact


def masks_of(photos: Photos, wanted: MasksFrom) -> tuple[Photos, Tensor]:
    """The photographs with masks that fit, as far as those are too wide, and `mask_distances`.

    Args:
        wanted: as of the configuration.
    """
    coverage = photos.coverage()
    distance = mask_distances(coverage)
    off = too_wide(photos.color, coverage, distance)
    if not off:
        return photos, distance
    much = f"masks are {off} {'pixel' if off == 1 else 'pixels'} too wide"
    if wanted == "given":
        print(f"{much}: see --masks auto")
        return photos, distance
    print(f"{much}: they are taken in")
    coverage = taken_in(distance, off)
    stored = coverage if photos.alpha.is_floating_point() else (255 * coverage).round().byte()
    return replace(photos, alpha=stored), mask_distances(coverage)


def object_box(
    distance: Tensor, cameras: Cameras, wanted: CamerasFrom
) -> tuple[tuple[Tensor, Tensor], bool]:
    """Corners [3], [3] of a box around the object, and whether its cameras are to be refined.

    Args:
        distance: [V, H, W] from `hull.mask_distances`.
        wanted: as of the configuration.

    Raises:
        ValueError: the silhouettes share no volume.
    """
    box = estimate_bounds(distance, cameras)
    off = contradiction(distance, cameras, box)
    refined = wanted == "refined" or (wanted == "auto" and off > AGREEING)
    if off > AGREEING:
        then = "cameras are refined" if refined else "see --cameras refined"
        print(f"silhouettes contradict one another by {off:.1f} pixels: {then}")
    if refined and off > 0:  # what the silhouettes share is too small by so much
        box = estimate_bounds(distance - off, cameras)
    return box, refined


def put_right(distance: Tensor, cameras: Cameras, box: tuple[Tensor, Tensor]) -> PoseSteps:
    """Steps to cameras whose silhouettes agree, as far as these tell; says how far they went.

    Args:
        distance, box: see `object_box`.
    """
    half = (box[1] - box[0]) / 2
    poses = PoseSteps(len(cameras))
    poses.about(cameras, box[0] + half, float(half.max()))
    align(poses, distance, cameras, box)
    moved = poses.moved(cameras).square().mean().sqrt()
    left = contradiction(distance, poses.eval().corrected(cameras), box)
    left = f"still contradict one another by {left:.1f} pixels" if left > AGREEING else "agree"
    print(f"cameras moved the object by {moved:.1f} pixels on average: silhouettes {left}")
    return poses
