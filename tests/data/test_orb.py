"""Stanford-ORB: its masks, splits, views of other scenes, and truth in folders above the scene."""

import json

import numpy as np
import pytest
import torch
from layouts import HEIGHT, WIDTH, angle, scene, write_colmap

from univoxel.color import srgb_to_linear
from univoxel.data import load_photos, load_truth
from univoxel.data.images import write_exr, write_png
from univoxel.errors import DataError


def write_orb(root, name="ball_scene001"):
    """blender_HDR/NAME with linear photographs and masks in folders of their own."""
    written, folder = scene(), root / "blender_HDR" / name
    for split in ("train", "test"):
        for place in (split, f"{split}_mask"):
            (folder / place).mkdir(parents=True)
        frames = []
        for v in written.split(split):
            planes = {c: written.pictures[v, ..., i] / 255 for i, c in enumerate("RGB")}
            write_exr(folder / split / f"{v:04d}.exr", planes, half=False)
            write_png(folder / f"{split}_mask" / f"{v:04d}.png", written.pictures[v, ..., 3])
            matrix = written.poses[v].tolist()
            frames.append({"file_path": f"{split}/{v:04d}", "transform_matrix": matrix})
        text = json.dumps({"camera_angle_x": angle(), "frames": frames})
        (folder / f"transforms_{split}.json").write_text(text)
    return folder


def write_novel(folder, *scenes, **change):
    """Test views of other scenes; each frame has its own angle."""
    frames = [
        {
            "file_path": f"test/{v:04d}",
            "scene_name": name,
            "camera_angle_x": angle(),
            "transform_matrix": scene().poses[v].tolist(),
            **change,
        }
        for name in scenes
        for v in (0, 8)
    ]
    (folder / "transforms_novel.json").write_text(json.dumps({"frames": frames}))


def test_photographs_and_masks(tmp_path):
    photos, written = load_photos(write_orb(tmp_path)), scene()
    views = written.split("train")
    assert photos.color.dtype == torch.float32
    np.testing.assert_allclose(photos.color, written.pictures[views, ..., :3] / 255, rtol=1e-6)
    np.testing.assert_allclose(photos.coverage(), written.pictures[views, ..., 3] / 255)


def test_views_of_other_scenes(tmp_path):
    folder = write_orb(tmp_path)
    for name in ("ball_scene002", "ball_scene003"):
        write_orb(tmp_path, name)
    write_novel(folder, "ball_scene002", "ball_scene003")
    with pytest.raises(DataError, match="allow_outside"):
        load_photos(folder, "novel")
    photos = load_photos(folder, "novel", allow_outside=True)
    assert photos.names == [f"ball_scene00{s}_000{v}" for s in (2, 3) for v in (0, 8)]
    assert np.array_equal((255 * photos.coverage()[1]).round(), scene().pictures[8, ..., 3])


@pytest.mark.parametrize("name", ["../ball_scene002", "", "..", 7])
def test_other_scenes_lie_beside_the_scene(tmp_path, name):
    folder = write_orb(tmp_path)
    write_novel(folder, "x", scene_name=name)
    with pytest.raises(DataError, match="frame 0: expected the name of a folder as scene_name"):
        load_photos(folder, "novel", allow_outside=True)


def save(folder, place, array):
    path = folder.parent.parent / "ground_truth" / folder.name / place
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, array)
    else:
        write_png(path, array)


def test_truth(tmp_path):
    """Normals are the camera's, and become the world's; depth is 0 or -1 where there is nothing."""
    folder = write_orb(tmp_path)
    normal, depth = np.zeros((HEIGHT, WIDTH, 3)), np.full((HEIGHT, WIDTH), -1.0)
    normal[2, 3], depth[2, 3] = [0.6, 0.0, 0.8], 3.5
    albedo = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    save(folder, "surface_normal/0008.npy", normal)
    save(folder, "z_depth/0008.npy", depth)
    save(folder, "pseudo_gt_albedo/0008.png", albedo)
    photos = load_photos(folder, "test")
    truth = load_truth(photos, 1)
    right, _, back = scene().poses[8, :3, :3].T
    np.testing.assert_allclose(truth.normal[2, 3], 0.6 * right + 0.8 * back, atol=1e-6)
    assert not truth.normal[0, 0].any()
    assert truth.depth[2, 3] == 3.5
    assert truth.depth.sum() == 3.5
    assert torch.allclose(truth.albedo, srgb_to_linear(torch.tensor(128 / 255)))
    assert load_truth(photos, 0).normal is None  # view 0000 has none
    assert load_truth(load_photos(folder, "test", downscale=2), 1).depth.max() == 3.5


NORMAL, DEPTH = "surface_normal/0000.npy", "z_depth/0000.npy"


@pytest.mark.parametrize(
    ("place", "array", "message"),
    [
        (DEPTH, np.ones((2, 2)), r"0000.npy: expected 12x8 pixels .*, got 2x2"),
        (DEPTH, np.ones((8, 12, 1)), r"expected finite values \[H, W\], got \[8, 12, 1\]"),
        (DEPTH, np.full((8, 12), np.nan), r"finite values \[H, W\], got \[8, 12\] of float"),
        (NORMAL, np.ones((8, 12)), r"finite values \[H, W, 3\], got \[8, 12\]"),
        (NORMAL, np.ones((8, 12, 3), int), r"finite values \[H, W, 3\], .* of int64"),
    ],
)
def test_one_line_for_what_is_broken(tmp_path, place, array, message):
    folder = write_orb(tmp_path)
    save(folder, place, array)
    with pytest.raises(DataError, match=message):
        load_truth(load_photos(folder, "test"), 0)


def test_splits_of_the_colmap_layout(tmp_path):
    """llff_colmap_HDR: names in the model end in .png, the pictures in .exr."""
    write_colmap(tmp_path, scene())
    (tmp_path / "train_id.txt").write_text("p_000.png\np_002.png\np_003\n")
    (tmp_path / "test_id.txt").write_text("p_001.png\n\n")
    for v in range(10):
        (tmp_path / "images" / f"p_00{v}.png").unlink()
        planes = {c: np.full((HEIGHT, WIDTH), 0.5) for c in "RGB"}
        write_exr(tmp_path / "images" / f"p_00{v}.exr", planes)
    assert load_photos(tmp_path).names == ["p_000", "p_002", "p_003"]
    assert load_photos(tmp_path, "test").names == ["p_001"]
    with pytest.raises(DataError, match="expected train or test as the split, got val"):
        load_photos(tmp_path, "val")
    (tmp_path / "test_id.txt").write_text("nothing.png\n")
    with pytest.raises(DataError, match=r"test_id\.txt: missing images: nothing\.png \(1 of 1\)"):
        load_photos(tmp_path, "test")
    (tmp_path / "test_id.txt").write_text("\n")
    with pytest.raises(DataError, match=r"test_id\.txt: expected names of photographs, but"):
        load_photos(tmp_path, "test")
