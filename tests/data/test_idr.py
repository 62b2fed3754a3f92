"""cameras*.npz: what it may say, names of pictures and masks, and errors.

Axes are checked by test_layouts.
"""

import numpy as np
import pytest
from layouts import FOCAL, refused, scene, write_idr

from univoxel.data import load_photos
from univoxel.data.images import write_png
from univoxel.data.research import decomposed


def load_arrays(folder):
    with np.load(folder / "cameras_sphere.npz") as file:
        return dict(file)


def save_arrays(folder, arrays):
    np.savez(folder / "cameras_sphere.npz", **arrays)


@pytest.mark.parametrize("factor", [-3.0, 1e-4, 250.0])
def test_projections_have_any_scale_and_sign(tmp_path, factor):
    wanted = load_photos(write_idr(tmp_path / "a", scene())).cameras
    found = load_photos(write_idr(tmp_path / "b", scene(), factor=factor)).cameras
    for key in ("camera_to_world", "focal", "centre"):
        np.testing.assert_allclose(getattr(found, key), getattr(wanted, key), atol=1e-5)


@pytest.mark.parametrize("file", ["cameras.npz", "cameras_large.npz"])
def test_other_files(tmp_path, file):
    photos = load_photos(write_idr(tmp_path, scene(), file))
    assert photos.cameras.focal.flatten().tolist() == pytest.approx([FOCAL] * 16)
    assert f"IDR layout ({file})" in photos.about


def test_the_parts_of_a_projection():
    """Skew, too, and focal lengths that differ."""
    intrinsics = np.array([[900.0, 0.25, 310.0], [0, 880.0, 245.0], [0, 0, 1]])
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    place = np.array([0.5, -2.0, 7.0])
    found, pose = decomposed(intrinsics @ np.column_stack([turn, -turn @ place]), "here")
    np.testing.assert_allclose(found, intrinsics, atol=1e-9)
    np.testing.assert_allclose(pose[:, 3], place, atol=1e-12)
    np.testing.assert_allclose(pose[:, :3].T, np.diag([1, -1, -1]) @ turn, atol=1e-12)


def renamed(folder, place, name):
    for v, path in enumerate(sorted((folder / place).iterdir())):
        path.rename(folder / place / name.format(v))


@pytest.mark.parametrize(
    ("image", "mask"),
    [
        ("{:06d}.png", "{:03d}.png"),  # DTU in NeuS
        ("rect_{:03d}_3_r5000.png", "{:03d}.png"),  # by their place
        ("{:08d}.png", "{:08d}.png"),
    ],
)
def test_names_of_masks(tmp_path, image, mask):
    written = scene()
    write_idr(tmp_path, written)
    renamed(tmp_path, "image", image)
    renamed(tmp_path, "mask", mask)
    alpha = load_photos(tmp_path).alpha.numpy()
    assert np.array_equal(alpha, written.pictures[written.split("train"), ..., 3])


def test_pictures_that_are_not_there(tmp_path):
    """Those that are there are known by their numbers."""
    written = scene()
    write_idr(tmp_path, written)
    for place in ("image", "mask"):
        renamed(tmp_path, place, "{:03d}.png")
        (tmp_path / place / "004.png").unlink()
    photos = load_photos(tmp_path)
    assert photos.names == ["001", "002", "003", "005", "006", "007", "008"]
    assert "1 of 10 listed images were left out" in photos.about
    wanted = written.poses[[1, 2, 3, 5, 6, 7, 8], :3, 3]
    np.testing.assert_allclose(photos.cameras.camera_to_world[:, :, 3], wanted, atol=1e-5)


def edited(change):
    def apply(folder):
        arrays = load_arrays(folder)
        change(arrays)
        save_arrays(folder, arrays)

    return apply


def leaning(arrays):
    """Pixels sheared by 2 in 8 rows."""
    shear = np.eye(4)
    shear[0, 1] = 0.25
    arrays["world_mat_3"] = shear @ arrays["world_mat_3"]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            lambda f: (f / "cameras_sphere.npz").write_bytes(b"no archive"),
            "cameras_sphere.npz: this npz file could not be read",
        ),
        (edited(dict.clear), "cameras_sphere.npz: expected arrays world_mat_0, .* got none"),
        (edited(lambda a: a.update(world_mat_2=np.eye(3))), "npz: expected a 4x4 matrix"),
        (
            edited(lambda a: a.update(world_mat_2=np.full((4, 4), "a"))),
            "npz: expected arrays of numbers, but world_mat_2 is of type <U1",
        ),
        (
            edited(lambda a: a.update(world_mat_2=np.full((4, 4), np.nan))),
            "npz: world_mat_2 contains NaN or infinity",
        ),
        (
            edited(lambda a: a.update(world_mat_2=np.ones((4, 4)))),
            "world_mat_2: expected an invertible projection matrix, got a singular one",
        ),
        (edited(leaning), "world_mat_3: .* rows shifted by up to 1 pixels"),
        (
            edited(lambda a: a.update(world_mat_2=np.diag([50.0, 1, 1, 1]) @ a["world_mat_2"])),
            "world_mat_2: expected cx between -12 and 24, got 300",
        ),
        (edited(lambda a: a.pop("world_mat_9")), "expected a matrix world_mat for each of 10"),
        (lambda f: (f / "image").rename(f / "photos"), "npz: expected images in .*image, f"),
        (
            lambda f: write_png(f / "mask" / "p_003.png", np.ones((4, 4), np.uint8)),
            "p_003.png: expected 12x8 pixels, got 4x4",
        ),
    ],
)
def test_one_line_for_what_is_broken(tmp_path, damage, message):
    refused(write_idr(tmp_path, scene()), damage, message)
