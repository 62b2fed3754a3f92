"""Masks as people draw them, against what is said of them."""

import numpy as np
import pytest
import torch
from analytic import photos_of
from scipy import ndimage

from lab.stress import rough
from lab.stress.axes import AXES

VIEWS, SIZE = 20, 64


@pytest.fixture(scope="module")
def photos():
    return photos_of(VIEWS, SIZE)


def drawn(photos, percent, seed=0):
    return rough.rough_masks(photos.alpha.numpy(), percent, np.random.default_rng(seed))


def test_some_lack_a_part_and_some_keep_ground(photos):
    masks = drawn(photos, 1.0)
    assert masks.dtype == np.float32
    assert set(np.unique(masks)) == {0, 1}
    true = photos.alpha.numpy() > 0.5
    outside, depth = (ndimage.distance_transform_edt(m) for m in (~true[0], true[0]))
    deviation = 0.01 * SIZE
    lost, kept = (
        [bool((wrong & (far > 6 * deviation)).any()) for wrong in wrongs]
        for wrongs, far in ((true & (masks == 0), depth), ((masks == 1) & ~true, outside))
    )  # six sigma: no jagged edge reaches so far
    assert (sum(lost), sum(kept)) == (1, 1)  # a tenth of the views, in turn


def test_edges_are_jagged_and_masks_end_early(photos, monkeypatch):
    monkeypatch.setattr(rough, "SPOILT", 0.0)
    masks, true = drawn(photos, 2.0), photos.alpha.numpy() > 0.5
    wrong = (masks > 0.5) != true
    around = ndimage.binary_dilation(true[0]) & ~ndimage.binary_erosion(true[0])
    # A deviation of 1.3 pixels: about that many wrong ones to a pixel of the edge, both ways
    assert 0.3 < wrong.sum() / VIEWS / (around.sum() / 2) < 1.5
    last = [int(m.any(1).nonzero()[0][-1]) for m in masks]
    assert len(set(last)) > 1


def test_the_edge_of_some_pictures_cuts_the_object(photos):
    found = rough.shifted(photos, 2.0, np.random.default_rng(0))
    moved = (found.cameras.centre != photos.cameras.centre).any(1)
    assert moved.sum() == 4
    for view in range(VIEWS):
        share = float(found.alpha[view].sum() / photos.alpha[view].sum())
        assert (share < 0.95) == bool(moved[view])  # 15 % of a disc's width is 9 % of its area
        by = int(found.cameras.centre[view, 0] - photos.cameras.centre[view, 0])
        rolled = torch.roll(photos.alpha[view], by, 1)
        both = found.alpha[view] > 0
        assert torch.equal(found.alpha[view][both], rolled[both])
        if moved[view]:
            assert found.alpha[view][:, [0, -1]].any()


def test_severities_begin_with_exact_masks():
    levels = AXES["rough-masks"].levels
    assert levels[0].damage.rough == 0
    assert [level.random for level in levels] == [False, True, True, True]
    assert [level.damage.rough for level in levels] == sorted(level.value for level in levels)
