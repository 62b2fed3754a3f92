"""Sheets of masks: worst first, before and after."""

import numpy as np
import pytest
import torch

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


def tile(name, agreement, fault="", value=0.5, after=None):
    return MaskTile(name, agreement, fault, torch.full((TILE, TILE, 3), value), after)


def test_the_worst_come_first():
    tiles = [
        tile("b", 0.9),
        tile("a", 0.9),
        tile("c", 0.95),
        tile("d", 0.91, "misses part of the object"),
    ]
    tiles += [tile("e", 0.2, "includes more than the object"), tile("f", 0.1)]
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
