"""TensoIR-Synthetic: which pictures are trained on, and errors."""

import pytest
from layouts import edited, refused, scene, write_tensoir

from univoxel.data import load_photos
from univoxel.errors import DataError


@pytest.fixture
def data(tmp_path):
    return write_tensoir(tmp_path, scene())


def rename(folder, name):
    for path in folder.glob("*/rgba_sunset.png"):
        path.rename(path.with_name(name))


def test_names_are_those_of_the_folders(data):
    assert load_photos(data).names == [f"train_{i:03d}" for i in range(8)]
    assert load_photos(data, "test").names == ["test_000", "test_001"]


def test_the_light_of_the_photographs(data):
    for view in range(2):  # relit test views
        path = data / f"test_{view:03d}" / "rgba_city.png"
        path.write_bytes((data / "train_000" / "rgba_sunset.png").read_bytes())
    assert "(rgba_sunset.png)" in load_photos(data, "test").about
    rename(data, "rgba_night.png")  # the only one of the training views
    assert "(rgba_night.png)" in load_photos(data, "test").about


def test_nerfactors_name(data):
    rename(data, "rgba.png")
    assert "(rgba.png)" in load_photos(data).about


def meta(**values):
    return edited("train_001/metadata.json", lambda root: root.update(values))


def two_lights(folder):
    (folder / "train_000" / "rgba_sunset.png").rename(folder / "train_000" / "rgba_a.png")
    (folder / "train_000" / "rgba_b.png").touch()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (meta(cam_transform_mat="1,2,3"), "expected 16 numbers in cam_transform_mat, got '1,2,3'"),
        (meta(cam_transform_mat="a,b"), "expected JSON with cam_transform_mat, numbers"),
        (meta(cam_transform_mat=[1.0]), "expected JSON with cam_transform_mat, numbers"),
        (meta(cam_angle_x=40), "expected cam_angle_x between 0 and 3.142, got 40"),
        (meta(imw=13), r"metadata\.json: expected images of 13x8 pixels .*, got 12x8"),
        (
            lambda f: [(f / f"train_00{v}" / "rgba_sunset.png").unlink() for v in range(5)],
            r"missing images: .*train_000/rgba_sunset\.png, .* \(5 of 8\)",
        ),
        (two_lights, r"train_000: expected rgba\.png, .* got rgba_a\.png, rgba_b\.png"),
    ],
)
def test_broken_scenes(data, change, message):
    refused(data, change, message)


def test_a_split_that_is_not_there(data):
    with pytest.raises(DataError, match=r"expected val_000/metadata\.json and so on, found none"):
        load_photos(data, "val")
