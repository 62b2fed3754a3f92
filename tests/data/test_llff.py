"""LLFF's rows: their axes are checked by test_layouts; here sizes, places and what is broken."""

import numpy as np
import pytest
from layouts import refused, scene, write_llff

from univoxel.data import load_photos
from univoxel.data.images import write_png


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


def rows(change):
    """What makes other rows of them, written again."""

    def apply(folder):
        path = folder / "poses_bounds.npy"
        np.save(path, change(np.load(path)), allow_pickle=True)

    return apply


def one(row, column, new):
    """A change of one number, from what it was."""

    def apply(found):
        found[row, column] = new(found[row, column])
        return found

    return rows(apply)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            lambda f: (f / "poses_bounds.npy").write_bytes(b"no array"),
            "poses_bounds.npy: this NumPy array could not be read",
        ),
        (rows(lambda _: np.array({"a": 1})), "npy: this NumPy array could not be read"),
        (rows(lambda r: r[:, :15]), r"npy: expected rows of 17 numbers, got shape \(10, 15\)"),
        (rows(lambda r: r.astype(str)), r"npy: expected rows of numbers, got 10 rows of <U"),
        (rows(lambda r: r[1:]), "expected a row for each of 10 photographs in .*images, got 9"),
        (one(2, 14, lambda _: 0), "row 2: expected height, width and focal length above 0, got"),
        (one(3, 4, lambda x: 2 * x), r"p_003.png: expected the aspect ratio 12x16 of its"),
        (one(1, 0, lambda x: x + 0.5), "row 1: expected rotation and translation"),
        (
            lambda f: [path.unlink() for path in (f / "images").iterdir()],
            "poses_bounds.npy: expected images in .*images, images_2, images_4 or similar",
        ),
    ],
)
def test_one_line_for_what_is_broken(tmp_path, damage, message):
    refused(write_llff(tmp_path, scene()), damage, message)
