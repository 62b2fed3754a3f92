"""LLFF's rows: their axes are checked by test_layouts; here sizes, places and what is broken."""

import numpy as np
import pytest
from layouts import FOCAL, scene, write_llff

from univoxel.data import load_photos
from univoxel.data.images import write_png
from univoxel.errors import DataError


@pytest.mark.parametrize("place", ["images", "images_4"])
def test_rows_may_describe_larger_originals(tmp_path, place):
    photos = load_photos(write_llff(tmp_path, scene(), original=4, place=place))
    assert photos.cameras.focal.unique().tolist() == [FOCAL]
    assert (photos.cameras.width, photos.cameras.height) == (12, 8)


def test_the_largest_photographs_are_read(tmp_path):
    write_llff(tmp_path, scene(width=6, height=4), original=8, place="images_8")
    write_llff(tmp_path, scene(), original=4, place="images_4")
    assert load_photos(tmp_path).cameras.width == 12


@pytest.mark.parametrize("odd", [0, 1])
def test_masks_of_the_originals(tmp_path, odd):
    """images_4 beside masks of four times the size, rows and columns left over cut off."""
    write_llff(tmp_path, scene(), original=4, place="images_4")
    (tmp_path / "masks").mkdir()
    block = np.tile(np.repeat(np.uint8([0, 140, 180, 240]), 1), (4, 1))  # mean 140
    for path in (tmp_path / "masks_4").iterdir():
        path.unlink()
        whole = np.pad(np.tile(block, (8, 12)), ((0, odd), (0, odd)))
        write_png(tmp_path / "masks" / path.name, whole)
    assert (load_photos(tmp_path).alpha == 140).all()


def change(folder, rows):
    np.save(folder / "poses_bounds.npy", rows)


def broken_file(folder, rows):
    (folder / "poses_bounds.npy").write_bytes(b"no array")


def an_object(folder, rows):
    np.save(folder / "poses_bounds.npy", np.array({"a": 1}), allow_pickle=True)


def few_columns(folder, rows):
    change(folder, rows[:, :15])


def words(folder, rows):
    change(folder, rows.astype(str))


def one_row_less(folder, rows):
    change(folder, rows[1:])


def no_focal(folder, rows):
    rows[2, 14] = 0
    change(folder, rows)


def another_shape(folder, rows):
    rows[3, 4] *= 2
    change(folder, rows)


def sheared(folder, rows):
    rows[1, 0] += 0.5
    change(folder, rows)


def no_pictures(folder, rows):
    for path in (folder / "images").iterdir():
        path.unlink()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (broken_file, "poses_bounds.npy: expected an array of NumPy, could not read it"),
        (an_object, "poses_bounds.npy: expected an array of NumPy, could not read it"),
        (few_columns, r"poses_bounds.npy: expected \[V, 17\] numbers, got \(10, 15\)"),
        (words, r"poses_bounds.npy: expected \[V, 17\] numbers, got 10 of <U"),
        (one_row_less, "expected a row for each of 10 photographs in .*images, got 9"),
        (no_focal, "row 2: expected height, width and focal length above 0, got 8, 12, 0"),
        (another_shape, r"p_003.png: expected a picture of the shape 12x16 as in .*, got 12x8"),
        (sheared, "row 1: expected a rigid transform_matrix"),
        (no_pictures, "poses_bounds.npy: no pictures in .*images or images_2, images_4"),
    ],
)
def test_one_line_for_what_is_broken(tmp_path, damage, message):
    write_llff(tmp_path, scene())
    damage(tmp_path, np.load(tmp_path / "poses_bounds.npy"))
    with pytest.raises(DataError, match=message):
        load_photos(tmp_path)
