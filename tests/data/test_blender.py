"""The NeRF/Blender and Synthetic4Relight layouts, and a clear error for each way to break them."""

import json
import math
import threading
from functools import partial

import numpy as np
import pytest
import torch
from layouts import edited, refused

from univoxel.data import load_photos
from univoxel.data.images import write_exr, write_png
from univoxel.data.transforms import RIGID_TOLERANCE, find_image
from univoxel.errors import DataError

WIDTH, HEIGHT, ANGLE = 6, 4, 0.8


def pose(angle=0.3):
    c, s = math.cos(angle), math.sin(angle)
    return [[c, -s, 0.0, 1.0], [s, c, 0.0, 2.0], [0.0, 0.0, 1.0, 3.0], [0.0, 0.0, 0.0, 1.0]]


def rgba(seed=0):
    return np.random.default_rng(seed).integers(1, 256, (HEIGHT, WIDTH, 4), dtype=np.uint8)


@pytest.fixture
def scene(tmp_path):
    """Two views in the layout of NeRF-synthetic."""
    (tmp_path / "train").mkdir()
    for view in range(2):
        write_png(tmp_path / "train" / f"r_{view}.png", rgba(view))
    frames = [
        {"file_path": f"./train/r_{view}", "transform_matrix": pose(view)} for view in range(2)
    ]
    save(tmp_path, {"camera_angle_x": ANGLE, "frames": frames})
    return tmp_path


def save(folder, transforms, split="train"):
    (folder / f"transforms_{split}.json").write_text(json.dumps(transforms))


edit = partial(edited, "transforms_train.json")


def test_photos_and_cameras(scene):
    photos = load_photos(scene)
    assert photos.names == ["r_0", "r_1"]
    assert photos.folder == scene
    for view in range(2):
        assert np.array_equal(photos.color[view].numpy(), rgba(view)[..., :3])
        assert np.array_equal(photos.alpha[view].numpy(), rgba(view)[..., 3])
    cameras = photos.cameras
    assert (cameras.width, cameras.height) == (WIDTH, HEIGHT)
    focal = 0.5 * WIDTH / math.tan(0.5 * ANGLE)
    torch.testing.assert_close(cameras.focal, torch.full((2, 2), focal))
    assert cameras.centre.tolist() == [[WIDTH / 2, HEIGHT / 2]] * 2
    torch.testing.assert_close(cameras.camera_to_world[1], torch.tensor(pose(1))[:3])


def test_names_with_extension_and_with_dots(scene):
    (scene / "train" / "r_1.png").rename(scene / "train" / "r_1.5.png")

    def change(transforms):
        transforms["frames"][0]["file_path"] = "train/r_0.png"
        transforms["frames"][1]["file_path"] = "train/r_1.5"

    edit(change)(scene)
    assert load_photos(scene).names == ["r_0", "r_1.5"]


def test_intrinsics_in_pixels(scene):
    def change(transforms):
        del transforms["camera_angle_x"]
        transforms.update(fl_x=7.0, fl_y=8.0, cx=2.5, cy=1.5, w=WIDTH, h=HEIGHT, k1=0.0)
        transforms["frames"][1]["fl_x"] = 9.0

    edit(change)(scene)
    cameras = load_photos(scene).cameras
    assert cameras.focal.tolist() == [[7.0, 8.0], [9.0, 8.0]]
    assert cameras.centre.tolist() == [[2.5, 1.5]] * 2


def test_one_focal_length_serves_both_axes(scene):
    root(fl_x=7.0)(scene)
    assert load_photos(scene).cameras.focal.tolist() == [[7.0, 7.0]] * 2


def test_rounded_matrices_become_rotations(scene):
    def change(transforms):
        matrix = np.array(pose(0.3))
        matrix[:3, :3] *= 1 + 0.5 * RIGID_TOLERANCE
        transforms["frames"][0]["transform_matrix"] = matrix.tolist()
        transforms["frames"][1]["transform_matrix"] = matrix[:3].tolist()

    edit(change)(scene)
    for matrix in load_photos(scene).cameras.camera_to_world:
        torch.testing.assert_close(matrix, torch.tensor(pose(0.3))[:3])


def test_synthetic4relight(tmp_path):
    """Training views are linear EXR with a mask, test views RGBA PNG."""
    for split in ("train", "test"):
        (tmp_path / split).mkdir()
        frames = [{"file_path": f"{split}/001", "transform_matrix": pose()}]
        save(tmp_path, {"camera_angle_x": ANGLE, "frames": frames}, split)
    linear = np.random.default_rng(0).random((HEIGHT, WIDTH, 3)).astype(np.float32) * 3
    linear[0, 0] = -0.01  # a filter's undershoot
    channels = {name: linear[..., k] for k, name in enumerate("RGB")}
    write_exr(tmp_path / "train" / "001_rgb.exr", channels, half=False)
    mask = rgba(1)[..., 0]
    write_png(tmp_path / "train" / "001_mask.png", mask)
    write_png(tmp_path / "test" / "001_rgba.png", rgba(2))

    train = load_photos(tmp_path)
    assert train.names == ["001"]
    assert train.color.dtype == torch.float32
    assert np.array_equal(train.color[0].numpy(), linear.clip(0))
    assert np.array_equal(train.alpha[0].numpy(), mask)
    test = load_photos(tmp_path, "test")
    assert test.names == ["001"]
    assert np.array_equal(test.color[0].numpy(), rgba(2)[..., :3])


def test_exr_with_alpha_is_divided_by_it(scene):
    (scene / "train" / "r_0.png").unlink()
    (scene / "train" / "r_1.png").unlink()
    plane = np.full((HEIGHT, WIDTH), 0.25, np.float32)
    alpha = np.full((HEIGHT, WIDTH), 0.5, np.float32)
    alpha[0, 0] = 0.0
    for view in range(2):
        write_exr(scene / "train" / f"r_{view}.exr", dict.fromkeys("RGB", plane) | {"A": alpha})
    photos = load_photos(scene)
    assert photos.color[0, 1, 1].tolist() == [0.5] * 3
    assert photos.color[0, 0, 0].tolist() == [0.0] * 3
    assert float(photos.alpha[0, 1, 1]) == 0.5


def test_alpha_of_both_kinds_becomes_one(scene):
    for view in range(2):
        (scene / "train" / f"r_{view}.png").unlink()
    plane = np.full((HEIGHT, WIDTH), 0.25, np.float32)
    write_exr(scene / "train" / "r_0.exr", dict.fromkeys("RGBA", plane))
    write_exr(scene / "train" / "r_1.exr", dict.fromkeys("RGB", plane))
    write_png(scene / "train" / "r_1_mask.png", np.full((HEIGHT, WIDTH), 51, np.uint8))
    assert load_photos(scene).alpha[:, 0, 0].tolist() == pytest.approx([0.25, 0.2])


# Each way to break a data set


def without(folder, name):
    (folder / name).unlink()


def matrix(change):
    """An edit of the first frame's matrix."""

    def apply(folder):
        m = change(np.array(pose()))
        m = m.tolist() if isinstance(m, np.ndarray) else m
        edit(lambda t: t["frames"][0].update(transform_matrix=m))(folder)

    return apply


def frame(**values):
    return edit(lambda t: t["frames"][1].update(values))


def root(**values):
    return edit(lambda t: t.update(values))


def text(content):
    return lambda folder: (folder / "transforms_train.json").write_bytes(content)


def mixed(folder):
    without(folder, "train/r_1.png")
    plane = np.ones((HEIGHT, WIDTH), np.float32)
    write_exr(folder / "train" / "r_1.exr", dict.fromkeys("RGBA", plane))


def transparent(folder):
    for view in range(2):
        write_png(folder / "train" / f"r_{view}.png", np.zeros((HEIGHT, WIDTH, 4), np.uint8))


def opaque(folder):
    write_png(folder / "train" / "r_1.png", rgba()[..., :3])


def all_opaque(folder):
    for view in range(2):
        write_png(folder / "train" / f"r_{view}.png", np.full((HEIGHT, WIDTH, 4), 255, np.uint8))


def gray(folder):
    write_png(folder / "train" / "r_1.png", rgba()[..., 0])


def small_mask(folder):
    opaque(folder)
    write_png(folder / "train" / "r_1_mask.png", np.zeros((2, 2), np.uint8))


BROKEN = {
    "no transforms": (
        lambda f: without(f, "transforms_train.json"),
        r"expected photographs .*, got train\. If .* \(looked for transforms_train\.json, ",
    ),
    "a list": (text(b"[1, 2]"), r"expected a JSON object, got \[1, 2\]"),
    "no frames": (root(frames=[]), r"expected a list of frames, got \[\]"),
    "frames of another kind": (root(frames={"a": 1}), "expected a list of frames, got {'a': 1}"),
    "a frame of another kind": (root(frames=["r_0"]), "frame 0: expected a JSON object, got 'r_0'"),
    "a frame without a path": (
        frame(file_path=None),
        "frame 1: expected text in file_path",
    ),
    "no picture": (
        lambda f: without(f, "train/r_1.png"),
        r"train\.json: missing images: .*train/r_1 \(1 of 2\).*for the endings none, \.png",
    ),
    "empty path": (frame(file_path=""), "train.json: missing images"),
    "double name": (frame(file_path="./train/r_0.png"), "frame 1: the name r_0 .* occurs twice"),
    "distortion by k4": (frame(k4=0.1), "frame 1: expected only distortion terms k1 k2 k3 p1 p2"),
    "distortion in words": (frame(k2="no"), "frame 1: expected k2 between -inf and inf, got 'no'"),
    "too much distortion": (root(k1=20.0), "frame 0: removing lens distortion would leave"),
    "folding distortion": (root(k1=-10.0, k2=30.0), "frame 0: the lens distortion folds the"),
    "a fisheye": (root(is_fisheye=True), "frame 0: expected one of the camera models .* a fisheye"),
    "another camera": (frame(camera_model="EQUIRECTANGULAR"), "models .* got 'EQUIRECTANGULAR'"),
    "size unlike the file's": (root(w=60, h=30), r"images of 60x30 pixels \(w and h\), got 6x4"),
    "transparent": (transparent, "all 2 images are fully transparent"),
    "opaque": (all_opaque, "all 2 images are fully opaque: cut out the object"),
    "no alpha": (opaque, r"r_1\.png: expected an alpha channel or a mask r_1_mask\.png"),
    "grey": (gray, r"r_1\.png: expected an image with 3 or 4 channels, got 1"),
    "mask of another size": (small_mask, r"r_1_mask\.png: expected 6x4 pixels, got 2x2"),
    "formats mixed": (mixed, "the same format as r_0"),
    "no matrix": (
        matrix(lambda m: None),
        "frame 0: expected a finite 4x4 transform_matrix, got None",
    ),
    "small matrix": (matrix(lambda m: m[:2]), "frame 0: expected a finite 4x4"),
    "ragged matrix": (matrix(lambda m: [[1.0], [1.0, 2.0]]), "frame 0: expected a finite 4x4"),
    "NaN in the matrix": (matrix(lambda m: m * np.nan), "frame 0: expected a finite 4x4"),
    "a singular one": (
        matrix(lambda m: m * [0, 1, 1, 1]),
        "frame 0: expected rotation .* scale of 1, 1, 0",
    ),
    "scaled matrix": (matrix(lambda m: m * [2, 2, 2, 1]), "rotation .* scale of 2, 2, 2"),
    "sheared matrix": (
        matrix(lambda m: m @ (np.eye(4) + 0.1 * np.eye(4, k=1) * [1, 1, 0, 0])),
        "frame 0: expected rotation",
    ),
    "just beyond the tolerance": (
        matrix(lambda m: m * [1 + 2 * RIGID_TOLERANCE, 1, 1, 1]),
        "frame 0: expected rotation",
    ),
    "mirrored": (matrix(lambda m: m * [-1, 1, 1, 1]), "frame 0: expected a rotation .* reflection"),
    "transposed": (matrix(lambda m: m.T), "frame 0: transform_matrix must end with 0 0 0 1"),
    "no angle": (
        edit(lambda t: t.pop("camera_angle_x")),
        "frame 0: expected camera_angle_x between 0 and 3.142, got nothing",
    ),
    "angle in degrees": (root(camera_angle_x=40.0), "camera_angle_x between 0 and 3.142, got 40.0"),
    "angle of NaN": (root(camera_angle_x=math.nan), "camera_angle_x .* got nan"),
    "angle of truth": (root(camera_angle_x=True), "camera_angle_x .* got True"),
    "focal length": (root(fl_x=-5.0), "expected fl_x between 0 and inf, got -5.0"),
    "second focal length": (root(fl_x=5.0, fl_y=0.0), "expected fl_y between 0 and inf, got 0.0"),
    "principal point": (root(cx=1000.0), "expected cx between -6 and 12, got 1000.0"),
    "principal point, y": (root(cy=-1000.0), "expected cy between -4 and 8, got -1000.0"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_scenes(scene, case):
    change, message = BROKEN[case]
    refused(scene, change, message)


def test_no_reader_outlives_an_error(scene):
    """One that did would be ended by the garbage collector, in whichever thread that runs: a thread
    that was just starting has hung in it."""
    BROKEN["formats mixed"][0](scene)
    before = threading.active_count()
    with pytest.raises(DataError, match="the same format as r_0") as caught:
        load_photos(scene)
    assert caught.value.__traceback__ is not None  # which holds all frames
    assert threading.active_count() == before


def test_missing_and_empty_folders(tmp_path):
    with pytest.raises(DataError, match="none: expected a folder with a scene, got nothing there"):
        load_photos(tmp_path / "none")
    with pytest.raises(DataError, match=r"got an empty folder.*\(looked for transforms_test"):
        load_photos(tmp_path, "test")
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="file: expected a folder with a scene, got a file"):
        load_photos(tmp_path / "file")


def test_full_folders_are_not_listed_whole(tmp_path):
    for k in range(9):
        (tmp_path / f"{k}.txt").write_text("")
    with pytest.raises(DataError, match=r"got 0\.txt, .*4\.txt, \.\.\.\. If .* \("):
        load_photos(tmp_path)


def test_an_exact_name_comes_first(tmp_path):
    for name in ("a.png", "a.png.png"):
        write_png(tmp_path / name, rgba())
    assert find_image(tmp_path, "a.png", "frame 0").name == "a.png"
