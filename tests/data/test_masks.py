"""Folders of masks: which is whose, and of what size."""

import re

import numpy as np
import pytest
import torch
from analytic import write_scene
from PIL import Image

from univoxel.data import load_photos
from univoxel.data.masks import masks_by_stem, read_mask
from univoxel.errors import DataError


def save(path, mask):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.asarray(mask, np.uint8)).save(path)
    return path


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "masks"


@pytest.mark.parametrize(
    "name",
    ["IMG_1.png", "IMG_1.JPG.png", "IMG_1_mask.png", "IMG_1.jpg_mask.jpg", "IMG_1_alpha.png"],
)
def test_whose_a_mask_is(tmp_path, folder, name):
    path = save(folder / name, np.zeros((2, 2)))
    save(folder / "IMG_10.png", np.zeros((2, 2)))
    assert masks_by_stem(folder, [("IMG_1", tmp_path / "IMG_1.JPG")]) == [path]


def test_folders_tell_apart_what_names_do_not(tmp_path, folder):
    paths = [save(folder / side / "1.png", np.zeros((2, 2))) for side in ("left", "right")]
    asked = [(f"{side}/1", tmp_path / side / "1.jpg") for side in ("left", "right")]
    assert masks_by_stem(folder, asked) == paths
    with pytest.raises(DataError, match=r"1\.jpg: expected one mask, got .*1\.png and .*1\.png"):
        masks_by_stem(folder, [("1", tmp_path / "1.jpg")])


def test_photographs_without_a_mask(tmp_path, folder):
    save(folder / "a.png", np.zeros((2, 2)))
    asked = [(name, tmp_path / f"{name}.jpg") for name in "abcdefgh"]
    message = "expected a mask for each of 8 photographs, got none for 7: b.jpg, c.jpg, d.jpg, "
    with pytest.raises(DataError, match=re.escape(message)):
        masks_by_stem(folder, asked)


def test_folders_that_are_none(tmp_path, folder):
    asked = [("a", tmp_path / "a.jpg")]
    with pytest.raises(DataError, match="masks: expected a folder of masks, got nothing there"):
        masks_by_stem(folder, asked)
    folder.mkdir()
    with pytest.raises(DataError, match=r"expected masks .*, got no picture"):
        masks_by_stem(folder, asked)


def test_masks_of_another_size(folder):
    mask = np.zeros((4, 6))
    mask[:, :3] = 255
    path = save(folder / "a.png", mask)
    assert torch.equal(read_mask(path, 6, 4), torch.from_numpy(mask).byte())
    larger = read_mask(path, 60, 40)
    assert larger.shape == (40, 60)
    assert (larger[:, :24] == 255).all()
    assert not larger[:, 36:].any()
    smaller = read_mask(path, 3, 2)
    assert smaller.tolist() == [[255, 128, 0]] * 2  # means
    with pytest.raises(DataError, match=r"a\.png: expected 40x60 pixels, got 6x4"):
        read_mask(path, 40, 60)


def test_alpha_is_the_mask_where_there_is_one(folder):
    rgba = np.zeros((2, 2, 4))
    rgba[0, :, 3], rgba[1, :, :3] = 255, 255
    assert read_mask(save(folder / "a.png", rgba), 2, 2).tolist() == [[255, 255], [0, 0]]


def test_photographs_with_masks_of_a_folder(tmp_path, folder):
    """They take the place of alpha in the pictures."""
    data = write_scene(tmp_path / "data", 3, 8)
    for view in range(3):
        mask = np.zeros((16, 16))
        mask[2 * view] = mask[2 * view + 1] = 255
        save(folder / f"r_{view}.png", mask)
    photos = load_photos(data, masks=folder)
    for view in range(3):
        rows = photos.alpha[view].float().mean(1)
        assert rows.nonzero()[:, 0].tolist() == [view]
