"""Pictures that are listed and not there are left out and counted, as long as enough remain."""

import json
import logging

import pytest
from layouts import scene, write_colmap, write_nerf, write_nerfstudio

from univoxel.data import load_photos
from univoxel.errors import DataError


def places(writer, v):
    """The picture of view v in a layout."""
    split = "test" if v % 8 == 0 else "train"
    return f"{split if writer is write_nerf else 'images'}/p_00{v}.png"


@pytest.mark.parametrize("writer", [write_colmap, write_nerf, write_nerfstudio])
def test_pictures_that_are_not_there_are_left_out(tmp_path, writer, caplog):
    data = writer(tmp_path, scene())
    lost = (2, 5, 6)
    for v in lost:
        (data / places(writer, v)).unlink()
    with caplog.at_level(logging.WARNING, "univoxel"):
        photos = load_photos(data)
    listed = 8 if writer is write_nerf else 10  # which has a file for each split
    assert f"3 of {listed} listed images were left out" in photos.about
    assert all(f"p_00{v}" in caplog.messages[0] for v in lost)
    assert caplog.messages[0].endswith(f"(3 of {listed} left out)")
    if writer is write_nerf:
        assert photos.names == ["p_001", "p_003", "p_004", "p_007", "p_009"]
        return
    # Every eighth of those that are there
    assert photos.names == ["p_001", "p_003", "p_004", "p_007", "p_008", "p_009"]
    assert load_photos(data, "test").names == ["p_000"]


def test_nothing_is_said_where_all_are_there(tmp_path, caplog):
    photos = load_photos(write_nerfstudio(tmp_path, scene()))
    assert "left out" not in photos.about
    assert not caplog.messages


@pytest.mark.parametrize(("views", "lost", "enough"), [(3, 1, 0), (4, 1, 1), (8, 4, 1), (8, 5, 0)])
def test_how_many_must_remain(tmp_path, views, lost, enough):
    data = write_colmap(tmp_path, scene(views))
    for v in range(lost):
        (data / "images" / f"p_00{v}.png").unlink()
    if enough:
        assert f"{lost} of {views} listed" in load_photos(data).about
        return
    with pytest.raises(DataError, match=rf"images.bin: missing .*\({lost} of {views}\)"):
        load_photos(data)


def test_splits_that_name_what_is_not_there(tmp_path):
    data = write_nerfstudio(
        tmp_path,
        scene(),
        train_filenames=["images/p_001.png", "images/p_002.png"],
        test_filenames=["images/p_003.png"],
    )
    (data / "images" / "p_002.png").unlink()
    assert load_photos(data).names == ["p_001"]
    (data / "images" / "p_003.png").unlink()
    with pytest.raises(DataError, match="frames in test_filenames, found 0 of 1"):
        load_photos(data, "test")


@pytest.mark.parametrize("named", ["p_00{}", "p_00{}.jpg", "p_00{}.HEIC", "p_00{}.PNG"])
@pytest.mark.parametrize("writer", [write_colmap, write_nerfstudio])
def test_names_without_their_ending_or_with_another(tmp_path, writer, named):
    """Photographs are converted after cameras were found; instant-ngp lists them without .png."""
    data = writer(tmp_path, scene(), **({"text": True} if writer is write_colmap else {}))
    file = data / ("sparse/0/images.txt" if writer is write_colmap else "transforms.json")
    text = file.read_text()
    for v in range(10):
        old = f"images/p_00{v}.png" if writer is write_nerfstudio else f"p_00{v}.png"
        text = text.replace(old, old[: -len(f"p_00{v}.png")] + named.format(v))
    file.write_text(text)
    assert load_photos(data).names == [f"p_00{v}" for v in (1, 2, 3, 4, 5, 6, 7, 9)]


def test_a_dot_in_a_name_is_no_ending(tmp_path):
    data = write_nerfstudio(tmp_path, scene())
    root = json.loads((data / "transforms.json").read_text())
    for k in (0, 1):  # p_009 and p_008
        root["frames"][k]["file_path"] = f"images/p_0.{k}"
    (data / "images" / "p_0.png").write_bytes((data / "images" / "p_001.png").read_bytes())
    (data / "transforms.json").write_text(json.dumps(root))
    assert "2 of 10 listed images were left out" in load_photos(data).about
