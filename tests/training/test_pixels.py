"""Which pixels are trained on, and the memory that training will need."""

import logging
from pathlib import Path

import pytest
import torch

from univoxel.camera import Cameras
from univoxel.config import StageConfig
from univoxel.core.machine import Memory
from univoxel.data import Photos
from univoxel.errors import UserError
from univoxel.preparation.hull import mask_distances
from univoxel.presets import preset
from univoxel.training.pixels import MARGIN, MOST, check_memory, most_pixels, needed, split_pixels

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


GB = 10**9


@pytest.fixture
def photos():
    """100 photographs of 4 million pixels that take no memory here."""
    alpha = torch.zeros(1, dtype=torch.uint8).expand(100, 2000, 2000)
    color = torch.zeros(1, dtype=torch.uint8).expand(100, 2000, 2000, 3)
    lens = torch.ones(100, 2)
    cameras = Cameras(torch.eye(3, 4).expand(100, 3, 4), lens, lens, 2000, 2000)
    return Photos(Path(), [f"{v}" for v in range(100)], color, alpha, cameras)


@pytest.fixture
def fast():
    return preset("fast", Path("photos"), Path("run"))


def test_little_that_is_free_is_a_warning(photos, fast, caplog):
    with caplog.at_level(logging.WARNING, "univoxel"):
        check_memory(photos, fast, Memory(32 * GB, 4 * GB))
    assert "100 photographs of 2000x2000 pixels needs about 11.1 GB; 4.0 of 32.0 GB are free" in (
        caplog.text
    )
    assert "pass downscale=2 or close other programs" in caplog.text
    caplog.clear()
    check_memory(photos, fast, Memory(32 * GB, 20 * GB))
    check_memory(photos, fast, Memory(32 * GB, None))
    assert not caplog.text


def test_more_than_there_is_in_all_is_refused(photos, fast):
    """With advice: where pixels are not what takes it, a smaller preset."""
    with pytest.raises(UserError, match=r"6\.0 of 8\.0 GB are free: pass downscale=2"):
        check_memory(photos, fast, Memory(8 * GB, 6 * GB))
    with pytest.raises(UserError, match="pass preset=draft"):
        check_memory(photos, fast, Memory(GB // 10, GB // 10))


@pytest.mark.parametrize("left", [GB, 2 * GB, 5 * GB])
def test_what_it_advises_is_enough_and_no_more(photos, fast, left):
    def shrunk(factor: int) -> Photos:
        alpha = photos.alpha[:, : 2000 // factor, : 2000 // factor]
        return Photos(Path(), photos.names, alpha[..., None], alpha, photos.cameras)

    with pytest.raises(UserError) as refused:
        check_memory(photos, fast, Memory(left, left))
    factor = int(str(refused.value).rpartition("=")[2])
    assert needed(shrunk(factor), fast) <= left < needed(shrunk(factor - 1), fast)


def test_a_training_keeps_no_more_pixels_than_it_has_use_for(fast, photos):
    """Twice the rays that it draws, whatever the size of the photographs; and never too many."""
    kinds = [preset(name, Path("photos"), Path("run")) for name in ("draft", "fast", "best")]
    kept = [most_pixels(cfg) for cfg in kinds]
    rays = sum(s.iterations * s.rays for s in fast.stages if isinstance(s, StageConfig))
    assert kept[0] < kept[1] == 2 * rays
    assert kept[2] == MOST
    # A finer grid and larger photographs need more
    full = preset("full", Path("photos"), Path("run"))
    few = Photos(Path(), ["0"], photos.color[:1], photos.alpha[:1], photos.cameras)
    assert needed(few, fast) < needed(few, full) < needed(photos, full)
