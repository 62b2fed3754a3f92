"""Photographs written with the masks that were found."""

from dataclasses import replace

import pytest
import torch
from analytic import photograph, write_scene
from PIL import Image
from sphere_in_room import SIZE, VIEWS, overlap, photographs, short

from univoxel.data import load_photos
from univoxel.data.shots import read_photo
from univoxel.errors import DataError
from univoxel.tasks import cutout as task


def test_what_cannot_be_written_leaves_nothing_behind_that_looks_whole(tmp_path, monkeypatch):
    def full(*_):
        raise OSError("no space left")

    data, out = write_scene(tmp_path / "data", 3, 8), tmp_path / "cut"
    monkeypatch.setattr(task, "find_object", lambda *_: None)
    monkeypatch.setattr(task, "mask", lambda scene, photos, view: torch.ones(8, 8))
    with monkeypatch.context() as patch:
        patch.setattr(task, "write_cameras", full)
        with pytest.raises(OSError, match="no space left"):
            task.cutout(data, out)
    assert not out.exists()
    assert task.cutout(data, out).is_dir()  # what was begun is not in the way


def test_what_is_written_can_be_trained_on(tmp_path, caplog):
    data = write_scene(tmp_path / "data", VIEWS, SIZE)
    photos = photographs(tmp_path)
    for view, name in enumerate(photos.names):  # no alpha at all
        Image.fromarray(photos.color[view].numpy()).save(data / "train" / f"{name}.png")
    with pytest.raises(DataError, match="univoxel cutout"):
        load_photos(data)
    out = tmp_path / "cut"
    caplog.set_level("INFO", "univoxel")
    assert task.cutout(str(data), str(out), config=short(20)) == out
    assert "photographs of 40x40 pixels" in caplog.text
    for split, count in (("train", VIEWS), ("test", 2)):
        cut, source = load_photos(out, split), load_photos(data, split, masks=False)
        assert len(cut) == count
        assert torch.equal(cut.color, source.color)
        torch.testing.assert_close(cut.cameras.focal, source.cameras.focal)
        torch.testing.assert_close(cut.cameras.camera_to_world, source.cameras.camera_to_world)
        true = torch.stack([photograph(source.cameras, v)[1] for v in range(count)])
        assert overlap(cut.coverage(), true) > 0.6  # each mask with its photograph
    with pytest.raises(FileExistsError, match="cut is there already: choose another out"):
        task.cutout(data, out)


def test_linear_photographs_stay_linear(tmp_path):
    photos = photographs(tmp_path)
    linear = replace(photos, color=torch.rand(VIEWS, SIZE, SIZE, 3), alpha=photos.alpha / 255)
    alpha = torch.full((SIZE, SIZE), 0.5)
    task.write_photo(tmp_path / "r_3", linear, 3, alpha)
    color, found = read_photo(tmp_path / "r_3.exr")
    torch.testing.assert_close(color, linear.color[3], atol=1e-3, rtol=1e-3)  # half floats
    assert torch.equal(found, alpha)


def test_a_data_set_without_test_views(tmp_path):
    data = write_scene(tmp_path / "data", VIEWS, SIZE)
    (data / "transforms_test.json").unlink()
    out = task.cutout(data, tmp_path / "cut", config=short(20))
    assert sorted(path.name for path in out.iterdir()) == ["train", "transforms_train.json"]
