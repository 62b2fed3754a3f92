"""transforms.json of nerfstudio and instant-ngp: what it may say, and errors."""

from functools import partial

import numpy as np
import pytest
from layouts import FOCAL, HEIGHT, WIDTH, angle, edited, refused, scene, write_nerfstudio

from univoxel.data import load_photos
from univoxel.data.images import write_png

edit = partial(edited, "transforms.json")


@pytest.fixture
def data(tmp_path):
    return write_nerfstudio(tmp_path, scene())


def test_instant_ngps_angle_and_paths(data):
    def change(root):
        for key in ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_model"):
            del root[key]
        root.update(camera_angle_x=angle(), camera_angle_y=0.6, scale=0.33, offset=[0.5] * 3)
        for frame in root["frames"]:
            frame.update(file_path=f"./{frame['file_path']}", sharpness=30.0)

    edit(change)(data)
    cameras = load_photos(data).cameras
    assert cameras.focal.flatten().tolist() == pytest.approx([FOCAL] * 16)
    assert cameras.centre[0].tolist() == [WIDTH / 2, HEIGHT / 2]


def test_intrinsics_of_a_frame(data):
    edit(lambda root: root["frames"][0].update(fl_x=20.0, cx=5.0))(data)  # p_009: last first
    cameras = load_photos(data).cameras
    assert cameras.focal[:, 0].tolist() == [FOCAL] * 7 + [20.0]
    assert cameras.centre[7].tolist() == [5.0, HEIGHT / 2]


def test_splits_of_the_file(data):
    names = {"train_filenames": ["images/p_003.png", "images/p_001.png"]}
    edit(lambda root: root.update(names, test_filenames=["images/p_000.png"]))(data)
    assert load_photos(data).names == ["p_003", "p_001"]
    assert load_photos(data, "test").names == ["p_000"]


def test_masks_without_mask_path(data):
    edit(lambda root: [frame.pop("mask_path") for frame in root["frames"]])(data)
    written = scene()
    assert np.array_equal(load_photos(data, "test").alpha[0], written.pictures[0, ..., 3])


def root(**values):
    return edit(lambda r: r.update(values))


def frame(**values):
    return edit(lambda r: r["frames"][1].update(values))


def other_size(folder):
    edit(lambda r: [r.pop("w"), r.pop("h")])(folder)
    write_png(folder / "images" / "p_008.png", np.ones((HEIGHT, 9, 3), np.uint8))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (frame(mask_path="masks/none.png"), r"frame 1: the mask .*masks/none\.png .*\(mask_path\)"),
        (frame(mask_path=7), "frame 1: the mask .*/7"),
        (root(test_filenames="p_000"), "expected a list of file_paths as test_filenames"),
        (root(test_filenames=[]), "to list only frames of this file, got an empty list"),
        (root(test_filenames=["x/y.png"]), "expected test_filenames to list only .*, got y"),
        (other_size, r"masks/p_008\.png: expected 9x8 pixels, got 12x8"),
    ],
)
def test_broken_files(data, change, message):
    """What every transforms file may have wrong is in test_blender."""
    refused(data, change, message, "test")
