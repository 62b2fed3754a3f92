"""Photographs written with the masks that were found."""

import html
import logging
import sys
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
import textured_room
import torch
from analytic import photograph, write_scene
from PIL import Image
from spoilt_masks import iou

from univoxel.camera import image_rays
from univoxel.capture import cutout as task
from univoxel.cli import main
from univoxel.data import load_photos
from univoxel.data.load_images import read_photo
from univoxel.data.transforms import write_cameras
from univoxel.errors import DataError, MissingExtra

ROOM = 20  # photographs of the furnished room
VIEWS, SIZE = 16, 40


def write_masks(folder, masks, stems):
    folder.mkdir(exist_ok=True)
    for stem, mask in zip(stems, masks, strict=True):
        picture = np.asarray(255 * mask.float()).astype(np.uint8)
        Image.fromarray(picture).save(folder / f"{stem}.png")
    return folder


@pytest.fixture
def by_brightness(monkeypatch):
    """A network for which what is not black is the object."""
    monkeypatch.setattr(task, "mask_network", lambda _: lambda photo: (photo.sum(-1) > 0).float())


def test_what_cannot_be_written_leaves_nothing_behind_that_looks_whole(
    tmp_path, monkeypatch, by_brightness
):
    data, out = write_scene(tmp_path / "data", 3, 8), tmp_path / "cut"
    with monkeypatch.context() as patch:
        patch.setattr(task, "write_cameras", Mock(side_effect=OSError("no space left")))
        with pytest.raises(OSError, match="no space left"):
            task.cutout(data, out)
    assert not out.exists()
    assert task.cutout(data, out).is_dir()  # what was begun is not in the way


def test_what_is_written_can_be_trained_on(tmp_path, caplog, by_brightness):
    data = write_scene(tmp_path / "data", VIEWS, SIZE)
    for path in data.glob("*/r_*.png"):  # no alpha at all
        picture = np.asarray(Image.open(path))
        Image.fromarray(picture[..., :3] * (picture[..., 3:] > 0)).save(path)
    with pytest.raises(DataError, match="univoxel cutout"):
        load_photos(data)
    out = tmp_path / "cut"
    caplog.set_level("INFO", "univoxel")
    assert task.cutout(str(data), str(out)) == out
    assert "photographs of 40x40 pixels" in caplog.text
    for split, count in (("train", VIEWS), ("test", 2)):
        cut, source = load_photos(out, split), load_photos(data, split, masks=False)
        assert len(cut) == count
        assert torch.equal(cut.color, source.color)
        torch.testing.assert_close(cut.cameras.focal, source.cameras.focal)
        torch.testing.assert_close(cut.cameras.camera_to_world, source.cameras.camera_to_world)
        for view in range(count):  # each mask with its photograph
            assert iou(cut.picture(view)[1], photograph(source.cameras, view)[1]) > 0.9
    with pytest.raises(FileExistsError, match="cut already exists: choose another folder for out"):
        task.cutout(data, out)
    (data / "transforms_test.json").unlink()
    out = task.cutout(data, tmp_path / "other")
    names = ["masks.html", "masks.png", "train", "transforms_train.json"]
    assert sorted(path.name for path in out.iterdir()) == names
    # Smooth balls before nothing have no depth that could be found
    said = "use source=rembg or a folder of masks instead of source=none"
    with pytest.raises(DataError, match=said):
        task.cutout(data, tmp_path / "none", "none")
    assert not (tmp_path / "none").exists()


def test_linear_photographs_stay_linear(tmp_path):
    photos = load_photos(write_scene(tmp_path / "data", VIEWS, SIZE))
    linear = replace(photos, color=torch.rand(VIEWS, SIZE, SIZE, 3), alpha=photos.alpha / 255)
    alpha = torch.full((SIZE, SIZE), 0.5)
    task.write_photo(tmp_path / "r_3", linear, 3, alpha)
    color, found = read_photo(tmp_path / "r_3.exr")
    torch.testing.assert_close(color, linear.color[3], atol=1e-3, rtol=1e-3)  # half floats
    assert torch.equal(found, alpha)


@pytest.fixture
def with_masks(tmp_path):
    """A scene of a sphere, and the true masks of its photographs by stem; test ones by theirs."""
    data = write_scene(tmp_path / "data", VIEWS, SIZE)
    (data / "transforms_test.json").unlink()
    photos = load_photos(data)
    return data, photos, [photos.picture(view)[1] for view in range(VIEWS)]


def test_masks_of_a_folder_are_repaired(tmp_path, with_masks, caplog):
    data, photos, true = with_masks
    masks = [mask.clone() for mask in true]
    masks[2][:] = 0
    masks[5][SIZE // 2 :] = 1  # what stands below
    folder, out = write_masks(tmp_path / "masks", masks, photos.names), tmp_path / "cut"
    caplog.set_level("INFO", "univoxel")
    assert task.cutout(data, out, folder) == out
    told = f"{VIEWS - 2} of {VIEWS} agree with the object's silhouette"
    assert told in caplog.text
    assert "1 include more than the object (r_5), 1 miss part of the object (r_2)" in caplog.text
    cut = load_photos(out)
    for view, mask in enumerate(true):
        found = cut.picture(view)[1]
        assert iou(found, mask) > 0.88 if view in (2, 5) else torch.equal(found, masks[view])
    page = (out / "masks.html").read_text()
    assert html.escape(told) in page
    assert page.index("train/r_2") < page.index("train/r_5") < page.index("train/r_0")
    assert (out / "masks.png").is_file()
    assert torch.equal(cut.color, photos.color)


def test_masks_that_are_mostly_wrong_stay(tmp_path, with_masks, caplog):
    """Each shows another place: there is no telling what is right."""
    data, photos, true = with_masks
    masks = [mask.roll((11 * (v % 3 - 1), 11 * (v % 4 - 1)), (0, 1)) for v, mask in enumerate(true)]
    folder, out = write_masks(tmp_path / "masks", masks, photos.names), tmp_path / "cut"
    task.cutout(data, out, folder)
    said = [r for r in caplog.records if r.levelno == logging.WARNING]
    assert len(said) == 1
    assert "no mask was corrected" in said[0].getMessage()
    assert "check masks.html" in said[0].getMessage()
    cut = load_photos(out)
    for view, mask in enumerate(masks):
        assert torch.equal(cut.picture(view)[1], mask)


def test_few_masks_stay_as_they_are(tmp_path, caplog):
    data = write_scene(tmp_path / "data", 4, 16)
    (data / "transforms_test.json").unlink()
    photos = load_photos(data)
    masks = [photos.picture(view)[1] for view in range(4)]
    folder = write_masks(tmp_path / "masks", masks, photos.names)
    task.cutout(data, tmp_path / "cut", folder)
    assert "this needs 12 photographs and there are only 4" in caplog.text
    masks[1][:] = 0
    write_masks(folder, masks, photos.names)
    with pytest.raises(DataError, match="the mask of r_1 is empty"):
        task.cutout(data, tmp_path / "other", folder)
    with pytest.raises(DataError, match="the mask of r_0 is empty inside the box"):
        task.cutout(data, tmp_path / "other", folder, box=(0, 0, 9, 1, 1, 10))
    (folder / "r_2.png").unlink()
    with pytest.raises(DataError, match=r"got none for 1: r_2\.png"):
        task.cutout(data, tmp_path / "other", folder)
    assert not (tmp_path / "other").exists()


def test_without_a_network_there_is_one_line(tmp_path, with_masks, monkeypatch, capsys):
    """And nothing was read or written."""
    monkeypatch.setitem(sys.modules, "rembg", None)
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    out = tmp_path / "cut"
    with pytest.raises(MissingExtra, match=r"pip install 'univoxel\[masks\]'.*--from FOLDER"):
        task.cutout(with_masks[0], out)
    assert main(["cutout", str(with_masks[0]), "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert said.startswith("univoxel cutout: making masks with a network needs rembg: ")
    assert said.count("\n") == 1
    assert not out.exists()


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """An object on a patterned floor in a furnished room: its folder, and its true masks."""
    folder, views = tmp_path_factory.mktemp("room"), textured_room.orbit(ROOM, 200, 150)
    (folder / "train").mkdir()
    true = []
    for view, seen in enumerate(views):
        picture, mask = textured_room.photograph(seen)
        picture.save(folder / "train" / f"r_{view:02}.png")
        true.append(torch.from_numpy(np.array(mask)).float() / 255)
    names = [f"r_{view:02}" for view in range(len(views))]
    write_cameras(folder, "train", textured_room.cameras(views), names)
    return folder, true


def test_what_stands_out_in_depth(tmp_path, room, caplog):
    caplog.set_level("INFO", "univoxel")
    data, true = room
    cut = load_photos(task.cutout(data, tmp_path / "cut", "none"))
    assert "masks were made from depth" in caplog.text
    agreed = [iou(cut.picture(view)[1], mask) for view, mask in enumerate(true)]
    assert np.mean(agreed) > 0.95
    assert min(agreed) > 0.93


def within(view, cameras, lower, upper):
    """The pixels whose surface lies in a box, by formula."""
    seen = textured_room.orbit(ROOM, 200, 150)[view]
    rays, away = image_rays(cameras, view), torch.from_numpy(textured_room.distance(seen))
    place = rays.origin + rays.direction * away.view(-1, 1)
    inside = (place > torch.tensor(lower)) & (place < torch.tensor(upper))
    return inside.all(1).view(away.shape).float()


def test_a_box_takes_the_table_out_of_all_masks(tmp_path, room, caplog):
    data, true = room
    photos = load_photos(data, masks=False)
    masks = [within(v, photos.cameras, (-1.1, -1, -0.1), (0.9, 1, 2)) for v in range(len(true))]
    assert np.mean([iou(a, b) for a, b in zip(masks, true, strict=True)]) < 0.6
    folder, box = write_masks(tmp_path / "masks", masks, photos.names), (-0.5, -0.5, 0.03)
    caplog.set_level("INFO", "univoxel")
    cut = load_photos(task.cutout(data, tmp_path / "cut", folder, box=(*box, 0.6, 0.5, 1.2)))
    assert "the object was found using masks of 20 photographs, the depth of " in caplog.text
    assert "% of its surface, the box; it extends from " in caplog.text
    agreed = [iou(cut.picture(view)[1], mask) for view, mask in enumerate(true)]
    assert np.mean(agreed) > 0.9
    assert min(agreed) > 0.85


def test_in_depth_a_box_ends_the_table_that_is_kept(tmp_path, room):
    data, true = room
    out, box = tmp_path / "cut", (-0.6, -0.6, -0.1, 0.6, 0.6, 1.2)
    options = ["--from", "none", "--box", *map(str, box), "--keep-table"]
    assert main(["cutout", str(data), "--out", str(out), *options]) == 0
    cut = load_photos(out)
    for view, mask in enumerate(true):
        inside = within(view, cut.cameras, box[:3], box[3:])
        assert iou(cut.picture(view)[1], inside) > 0.9
        assert iou(cut.picture(view)[1], mask) < 0.75


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--box", "0", "0", "0", "1", "1", "0"], "--box: expected X0 Y0 Z0 X1 Y1 Z1 with X0 < X1"),
        (["--box", "0", "0", "0", "1"], "--box"),
        (["--keep-table", "--from", "none"], "--keep-table needs a box that bounds the table"),
        (["--from", "none", "--network", "u2net"], "--network u2net applies only to masks from"),
        (["--network", "u2"], "Expected one of ('u2netp', 'silueta'"),
    ],
)
def test_options_of_masks_that_cannot_be(tmp_path, capsys, options, said):
    assert main(["cutout", str(tmp_path), "--out", str(tmp_path / "cut"), *options]) == 2
    assert said in capsys.readouterr().err
