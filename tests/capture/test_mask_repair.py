"""What a silhouette says of a mask, and the mask that it leaves."""

import torch
from analytic import cameras_around
from spoilt_masks import BESIDE, MISSING, iou, kept_table, lost_part, true_mask

from univoxel.capture.masks import judge, repaired, voxel_pixels
from univoxel.fields.grid import GridShape

CAMERAS = cameras_around(4, 128)
TRUE = true_mask(CAMERAS, 0)
COARSE = torch.nn.functional.avg_pool2d(TRUE[None], 4)[0] >= 0.5  # a silhouette of a coarse grid


def test_a_mask_that_fits_stays_as_it_is():
    soft = 0.8 * TRUE
    found = judge(soft, COARSE, 0.97, 1.0)
    assert found.fault == ""
    assert found.mask is soft


def test_what_is_wrong_is_named_and_repaired():
    for spoilt, fault in ((kept_table(CAMERAS, 0), BESIDE), (lost_part(TRUE), MISSING)):
        found = judge(spoilt, COARSE, 0.97, 1.0)
        assert found.fault == fault
        assert found.agreement < 0.9
        assert iou(found.mask, TRUE) > max(0.95, iou(spoilt, TRUE))


def test_an_empty_mask_misses_all():
    found = judge(torch.zeros_like(TRUE), COARSE, 0.97, 1.0)
    assert (found.fault, found.agreement) == (MISSING, 0)
    assert iou(found.mask, TRUE) > 0.93


def test_a_repaired_mask_keeps_its_own_edge_near_the_silhouette():
    """Where it ends there, above the table, it is more exact than voxels."""
    found = repaired(kept_table(CAMERAS, 0), COARSE, 1.0)
    voxels = torch.nn.functional.interpolate(COARSE.float()[None, None], TRUE.shape)[0, 0]
    assert iou(found[:40], TRUE[:40]) > iou(voxels[:40], TRUE[:40])


def test_width_of_a_voxel_in_pixels():
    grid = GridShape((-0.5, -0.5, -0.5), 0.1, (11, 11, 11))
    focal = float(CAMERAS.focal[0].mean())
    assert abs(voxel_pixels(grid, CAMERAS, 0) - 0.1 * focal / 2) < 1e-3
