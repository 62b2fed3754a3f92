"""Memory that training will need against what a machine has."""

import logging
from pathlib import Path

import pytest
import torch

from univoxel.camera import Cameras
from univoxel.config import StageConfig
from univoxel.core.machine import Memory
from univoxel.data import Photos
from univoxel.errors import UserError
from univoxel.presets import preset
from univoxel.training.pixels import MOST, check_memory, most_pixels, needed

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


def test_a_machine_that_has_enough_is_told_nothing(photos, fast, caplog):
    check_memory(photos, fast, Memory(32 * GB, 20 * GB))
    check_memory(photos, fast, Memory(32 * GB, None))
    assert not caplog.text


def test_little_that_is_free_is_a_warning(photos, fast, caplog):
    with caplog.at_level(logging.WARNING, "univoxel"):
        check_memory(photos, fast, Memory(32 * GB, 4 * GB))
    assert "100 photographs of 2000x2000 pixels needs about 11.1 GB; 4.0 of 32.0 GB are free" in (
        caplog.text
    )
    assert "pass downscale=2 or close other programs" in caplog.text


def test_more_than_there_is_in_all_is_refused(photos, fast):
    with pytest.raises(UserError, match=r"6\.0 of 8\.0 GB are free: pass downscale=2"):
        check_memory(photos, fast, Memory(8 * GB, 6 * GB))


@pytest.mark.parametrize("left", [GB, 2 * GB, 5 * GB])
def test_what_it_advises_is_enough_and_no_more(photos, fast, left):
    def shrunk(factor: int) -> Photos:
        alpha = photos.alpha[:, : 2000 // factor, : 2000 // factor]
        return Photos(Path(), photos.names, alpha[..., None], alpha, photos.cameras)

    with pytest.raises(UserError) as refused:
        check_memory(photos, fast, Memory(left, left))
    factor = int(str(refused.value).rpartition("=")[2])
    assert needed(shrunk(factor), fast) <= left < needed(shrunk(factor - 1), fast)


def test_where_pixels_are_not_what_takes_it_a_smaller_preset_is_advised(photos, fast):
    with pytest.raises(UserError, match="pass preset=draft"):
        check_memory(photos, fast, Memory(GB // 10, GB // 10))


def test_a_finer_grid_and_larger_photographs_need_more(photos, fast):
    full = preset("full", Path("photos"), Path("run"))
    few = Photos(Path(), ["0"], photos.color[:1], photos.alpha[:1], photos.cameras)
    assert needed(few, fast) < needed(few, full) < needed(photos, full)


def test_a_training_keeps_no_more_pixels_than_it_has_use_for(fast):
    """Twice the rays that it draws, whatever the size of the photographs; and never too many."""
    kinds = [preset(name, Path("photos"), Path("run")) for name in ("draft", "fast", "best")]
    kept = [most_pixels(cfg) for cfg in kinds]
    rays = sum(s.iterations * s.rays for s in fast.stages if isinstance(s, StageConfig))
    assert kept[0] < kept[1] == 2 * rays
    assert kept[2] == MOST
