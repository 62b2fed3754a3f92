"""Masks judged and repaired by a silhouette, and sheets of them: worst first, before and after."""

import numpy as np
import pytest
import torch
from analytic import cameras_around
from spoilt_masks import BESIDE, MISSING, iou, kept_table, lost_part, true_mask

from univoxel.capture.cutout import (
    COLUMNS,
    DARK,
    GAP,
    LABEL,
    TILE,
    MaskTile,
    darkened,
    mask_sheet,
    worst_first,
    write_page,
)
from univoxel.capture.masks import judge, repaired, voxel_pixels
from univoxel.fields.grid import GridShape


def tile(name, agreement, fault="", value=0.5, after=None):
    return MaskTile(name, agreement, fault, torch.full((TILE, TILE, 3), value), after)


def test_the_worst_come_first():
    tiles = [tile("b", 0.9), tile("a", 0.9), tile("c", 0.95), tile("f", 0.1)]
    tiles += [tile("d", 0.91, "misses part of the object"), tile("e", 0.2, "includes more")]
    assert [t.name for t in worst_first(tiles)] == ["e", "d", "f", "a", "b", "c"]
    unvoted = [tile("b", None), tile("a", None)]
    assert [t.name for t in worst_first(unvoted)] == ["a", "b"]


def test_photographs_are_dark_outside_of_the_mask():
    photograph = torch.full((4, 6, 3), 200, dtype=torch.uint8)
    mask = torch.zeros(4, 6)
    mask[:, :3] = 1
    picture = darkened(photograph, mask)
    torch.testing.assert_close(picture[:, :3], torch.full((4, 3, 3), 200 / 255))
    torch.testing.assert_close(picture[:, 3:], torch.full((4, 3, 3), DARK * 200 / 255))
    assert darkened(torch.rand(600, 300, 3), torch.ones(600, 300)).shape == (TILE, TILE // 2, 3)


def test_before_and_after_lie_beside_each_other():
    mended = tile("a", 0.5, "misses part of the object", 0.2, torch.full((TILE, TILE, 3), 0.8))
    sheet = mask_sheet([mended, *(tile(str(k), 0.9) for k in range(COLUMNS - 1))])
    assert sheet.shape == (2 * (TILE + LABEL + GAP), COLUMNS * (TILE + GAP), 3)
    row = sheet[LABEL + TILE // 2].astype(int)
    middle = TILE // 2 + (TILE + GAP) * np.arange(COLUMNS)
    assert row[middle, 0].tolist() == [51, 204] + 4 * [128]
    with pytest.raises(ValueError, match="expected photographs, got none"):
        mask_sheet([])


def test_the_page_needs_no_other_file(tmp_path):
    mended = tile("<a>", 0.5, "misses part of the object", 0.2, torch.full((TILE, TILE, 3), 0.8))
    write_page(tmp_path / "masks.html", [mended, tile("b", None)], "1 & 2")
    text = (tmp_path / "masks.html").read_text()
    assert text.count("data:image/jpeg;base64,") == 3
    assert "1 &amp; 2" in text
    assert "&lt;a&gt;  0.50 misses part of the object; the corrected mask is on the right" in text
    assert text.count('class="wrong"') == 1
    assert text.index("&lt;a&gt;") < text.index(">b")


# What a silhouette says of a mask, and the mask that it leaves


CAMERAS = cameras_around(4, 128)
TRUE = true_mask(CAMERAS, 0)
COARSE = torch.nn.functional.avg_pool2d(TRUE[None], 4)[0] >= 0.5  # a silhouette of a coarse grid


def test_what_is_wrong_is_named_and_repaired():
    soft = 0.8 * TRUE
    found = judge(soft, COARSE, 0.97, 1.0)
    assert found.fault == ""
    assert found.mask is soft
    found = judge(torch.zeros_like(TRUE), COARSE, 0.97, 1.0)
    assert (found.fault, found.agreement) == (MISSING, 0)
    assert iou(found.mask, TRUE) > 0.93
    for spoilt, fault in ((kept_table(CAMERAS, 0), BESIDE), (lost_part(TRUE), MISSING)):
        found = judge(spoilt, COARSE, 0.97, 1.0)
        assert found.fault == fault
        assert found.agreement < 0.9
        assert iou(found.mask, TRUE) > max(0.95, iou(spoilt, TRUE))


def test_a_repaired_mask_keeps_its_own_edge_near_the_silhouette():
    """Where it ends there, above the table, it is more exact than voxels."""
    found = repaired(kept_table(CAMERAS, 0), COARSE, 1.0)
    voxels = torch.nn.functional.interpolate(COARSE.float()[None, None], TRUE.shape)[0, 0]
    assert iou(found[:40], TRUE[:40]) > iou(voxels[:40], TRUE[:40])


def test_width_of_a_voxel_in_pixels():
    grid = GridShape((-0.5, -0.5, -0.5), 0.1, (11, 11, 11))
    focal = float(CAMERAS.focal[0].mean())
    assert abs(voxel_pixels(grid, CAMERAS, 0) - 0.1 * focal / 2) < 1e-3
