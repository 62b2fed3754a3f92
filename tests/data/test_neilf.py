"""sfm_scene.json: what it may say, and errors. Axes are checked by test_layouts."""

from functools import partial

import layouts
import numpy as np
import pytest
from layouts import refused, scene, write_neilf

from univoxel.data import load_photos

edited = partial(layouts.edited, "inputs/sfm_scene.json")


def image(change):
    """A change of image 3."""
    return edited(lambda root: change(root["camera_track_map"]["images"]["3"]))


def text(content):
    return lambda folder: (folder / "inputs" / "sfm_scene.json").write_text(content)


def test_images_that_were_not_placed(tmp_path):
    write_neilf(tmp_path, scene())
    image(lambda i: i.update(flg=1))(tmp_path)
    edited(lambda root: root["camera_track_map"]["images"].pop("5"))(tmp_path)
    (tmp_path / "inputs" / "images" / "p_002.png").unlink()
    photos = load_photos(tmp_path)
    assert photos.names == ["p_001", "p_004", "p_006", "p_007", "p_008", "p_009"]
    assert "are missing, 2 photographs left out because they have no camera" in photos.about


def test_names_as_the_readme_has_them(tmp_path):
    """A list, in image_list."""

    def change(root):
        root["image_list"] = {"file_paths": list(root.pop("image_path")["file_paths"].values())}

    write_neilf(tmp_path, scene())
    edited(change)(tmp_path)
    assert len(load_photos(tmp_path)) == 8


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (text("{"), "sfm_scene.json: invalid JSON in line 1"),
        (text("[1]"), r"sfm_scene.json: expected JSON with image_path.file_paths and"),
        (text("{}"), r"sfm_scene.json: expected JSON with .* KeyError\('image_list'\)"),
        (
            edited(lambda r: r["camera_track_map"].update(images=[])),
            "json: expected JSON with .*no images",
        ),
        (
            edited(lambda r: [i.update(flg=0) for i in r["camera_track_map"]["images"].values()]),
            "sfm_scene.json: expected images with cameras",
        ),
        (image(lambda i: i.pop("camera")), r"image 3: expected size \[w, h\] and a camera with"),
        (image(lambda i: i.update(size=[12])), r"image 3: expected size \[w, h\] and a camera"),
        (image(lambda i: i["camera"].update(extrinsic=[1.0] * 15)), "image 3: .* 16 numbers"),
        (
            image(lambda i: i["camera"].update(extrinsic=(2 * np.eye(4)).ravel().tolist())),
            "image 3: transform_matrix must end with 0 0 0 1",
        ),
        (
            image(lambda i: i["camera"]["intrinsic"].update(focal=[-1.0, 2.0])),
            "image 3: expected fl_x between 0 and inf, got -1.0",
        ),
        (image(lambda i: i.update(size=[-12, 8])), "image 3: expected w between 0 and inf, got -1"),
        (image(lambda i: i.update(size=[12, 12])), r"p_003.png: expected the aspect ratio"),
        (lambda f: (f / "inputs" / "images").rename(f / "photos"), "json: missing images: p_000"),
    ],
)
def test_one_line_for_what_is_broken(tmp_path, damage, message):
    refused(write_neilf(tmp_path, scene()), damage, message)
