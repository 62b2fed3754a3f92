"""Which pixels are trained on, and what later looks at the photographs see of doubted ones."""

from pathlib import Path

import torch

from univoxel.camera import Cameras
from univoxel.data import Photos
from univoxel.preparation.hull import mask_distances
from univoxel.training.pixels import MARGIN, split_pixels

SIZE = 40


def photographs():
    """Two photographs of a square of 12 pixels."""
    alpha = torch.zeros(2, SIZE, SIZE, dtype=torch.uint8)
    alpha[:, 14:26, 14:26] = 255
    color = torch.full((2, SIZE, SIZE, 3), 90, dtype=torch.uint8)
    pose = torch.eye(3, 4).expand(2, 3, 4)
    lens = torch.full((2, 2), 60.0), torch.full((2, 2), SIZE / 2)
    return Photos(Path(), ["a", "b"], color, alpha, Cameras(pose, *lens, SIZE, SIZE))


def test_every_pixel_near_a_silhouette_is_trained_on_or_held_out():
    photos = photographs()
    distance = mask_distances(photos.coverage())
    split = split_pixels(photos, distance)
    found = torch.cat([split.trained, split.held_out])
    assert len(found) == len(found.unique(dim=0)) == (distance < MARGIN).sum()
    assert len(split.held_out) == len(found) // 10
    view, row, column = found.long().unbind(1)
    assert (distance[view, row, column] < MARGIN).all()
    assert split.photos is photos


def test_doubted_pixels_are_left_out_and_show_no_object():
    photos = photographs()
    doubted = torch.zeros(photos.alpha.shape, dtype=torch.bool)
    doubted[0, :20] = True
    split = split_pixels(photos, mask_distances(photos.coverage()), doubted)
    view, row, column = torch.cat([split.trained, split.held_out]).long().unbind(1)
    assert len(view)
    assert not doubted[view, row, column].any()
    assert not split.photos.alpha[doubted].any()
    assert torch.equal(split.photos.alpha[~doubted], photos.alpha[~doubted])


def test_edges_of_rough_masks_are_not_held_out():
    photos = photographs()
    distance, nowhere = mask_distances(photos.coverage()), torch.zeros(2, SIZE, SIZE)
    given, rough = (split_pixels(photos, distance, d) for d in (None, nowhere.bool()))
    assert len(given.held_out) == len(rough.held_out)
    least = [distance[s.held_out.long().unbind(1)].abs().min() for s in (given, rough)]
    assert least[0] < 1
    assert least[1] >= 3
    both = torch.cat([rough.trained, rough.held_out])
    assert len(both) == len(both.unique(dim=0))
