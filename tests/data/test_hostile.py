"""Data sets that nobody made by mistake: numbers beyond all range, files of others, bombs."""

import struct
from functools import partial
from unittest.mock import Mock

import layouts
import numpy as np
import pytest
from layouts import (
    edited,
    replaced,
    scene,
    write_colmap,
    write_nerf,
    write_nerfstudio,
    write_tensoir,
)

from univoxel.core.files import read_json
from univoxel.data import load_cameras, load_photos
from univoxel.data.images import write_png
from univoxel.errors import DataError

GIANT = 10**400  # float() raises OverflowError


edit = partial(edited, "transforms.json")
cameras, images = (partial(replaced, f"sparse/0/{name}.txt") for name in ("cameras", "images"))


@pytest.fixture
def data(tmp_path):
    return write_nerfstudio(tmp_path / "data", scene())


def moved(place: object):
    def change(root):
        root["frames"][0]["transform_matrix"][0][3] = place

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: r.update(fl_x=GIANT), "frame 0: expected fl_x between 0 and inf, got 1000"),
        (lambda r: r.update(k1=GIANT), "frame 0: expected k1 between -inf and inf, got 1000"),
        (lambda r: r.update(fl_x=1e-320), "frame 0: expected focal lengths from 0.006 to 1.2e"),
        (lambda r: r.update(fl_x=1e39), "frame 0: expected focal lengths from 0.006 to 1.2e"),
        (lambda r: r.update(p1=1e30), "frame 0: expected distortion coefficients of magn"),
        (lambda r: [r.pop("fl_x"), r.update(camera_angle_x=1e-320)], "0: expected focal lengths"),
        (lambda r: [r.pop("fl_x"), r.update(camera_angle_x=3.14159265)], "expected focal lengths"),
        (moved(GIANT), "frame 0: expected a finite 4x4 transform_matrix, got"),
        (moved(1e308), r"frame 0: expected matrix values up to 1e\+09, got 1e\+308"),
        (lambda r: r["frames"][0].update(file_path="a\0b"), "expected text in file_path"),
        (lambda r: r["frames"][0].update(mask_path="a\0b"), "frame 0: the mask"),
    ],
)
def test_numbers_that_no_camera_has(data, change, message):
    edit(change)(data)
    with pytest.raises(DataError, match=rf"transforms\.json: .*{message}"):
        load_photos(data)


def test_a_camera_path_is_as_small_as_files_hold(data):
    edit(lambda r: r.update(w=10**9))(data)
    with pytest.raises(DataError, match=r"expected w between 0 and 6.554e\+04, got 1000000000"):
        load_cameras(data / "transforms.json", 64)


@pytest.mark.parametrize("number", ["9" * 400, "1e-320", "1e39"])
def test_numbers_of_colmap(tmp_path, number):
    folder = write_colmap(tmp_path, scene(), text=True)
    cameras(("11.0", number))(folder)
    with pytest.raises(DataError, match=r"cameras\.txt: .*(focal lengths|parameters \[inf)"):
        load_photos(folder)
    cameras((number, "11.0"), (" 12 ", f" {10**400} "))(folder)
    with pytest.raises(DataError, match=r"cameras\.txt: this file of a COLMAP model"):
        load_photos(folder)


def test_places_of_colmap(tmp_path):
    path = write_colmap(tmp_path, scene()) / "sparse/0/images.bin"
    data = bytearray(path.read_bytes())
    struct.pack_into("<d", data, 8 + 4 + 32, 1e300)
    path.write_bytes(data)
    with pytest.raises(DataError, match=r"images\.bin: .* the pose of p_009\.png is"):
        load_photos(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"[" * 100_000, "nested too deeply"),
        (b'{"a":' * 100_000, "nested too deeply"),
        (b'{"a": ' + b"1" * 5000 + b"}", "an integer has too many digits"),
        (b"\xff\xfe{}", "expected text in UTF-8"),
        (b"{", "invalid JSON in line 1, column 2"),
    ],
)
def test_json_that_cannot_be_read(data, tmp_path, text, message):
    tensoir = write_tensoir(tmp_path / "tensoir", scene())
    for path in (data / "transforms.json", tensoir / "train_001" / "metadata.json"):
        path.write_bytes(text)
        with pytest.raises(DataError, match=rf"{path.name}: .*{message}"):
            load_photos(data if path.parent == data else tensoir)


def test_a_byte_order_mark_is_no_fault(data):
    path = data / "transforms.json"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert "frames" in read_json(path)
    assert len(load_photos(data)) == 8


@pytest.mark.parametrize("layout", ["nerf", "colmap"])
def test_names_come_before_pictures(data, tmp_path, monkeypatch, layout):
    """120,000 frames of one name took two minutes: each picture was opened."""

    opened = Mock(side_effect=AssertionError("a picture was opened"))
    monkeypatch.setattr("univoxel.data.transforms.image_size", opened)
    monkeypatch.setattr("univoxel.data.colmap.image_size", opened)
    if layout == "nerf":
        edit(lambda r: r.update(frames=r["frames"][:1] * 9))(data)
        message = r"frame 1: the name p_009 of images/p_009\.png occurs twice"
    else:
        data = write_colmap(tmp_path / "colmap", scene(), text=True)
        images(("p_003.png", "p_004.png"))(data)
        message = r"images\.txt: expected unique, non-empty image names, got 'p_004\.png'"
    with pytest.raises(DataError, match=message):
        load_photos(data)


WRITERS = [write_nerf, write_nerfstudio, write_colmap, write_tensoir]


@pytest.mark.parametrize("writer", WRITERS)
def test_links_out_of_the_folder(tmp_path, writer):
    """A picture that is a link to one elsewhere is read where its owner says so."""
    data = writer(tmp_path / "data", scene())
    picture = sorted(data.rglob("*p_001.png") or data.rglob("train_000/*.png"))
    picture = picture[0] if picture else next(data.rglob("train_000/*.png"))
    elsewhere = tmp_path / "elsewhere.png"
    picture.rename(elsewhere)
    picture.symlink_to(elsewhere)
    with pytest.raises(DataError, match=r"expected files inside .*data, got .*elsewhere\.png"):
        load_photos(data)
    assert len(load_photos(data, allow_outside=True)) == 8
    # A link within, and a folder that is itself a link, are as any other
    inside = data / "inside.png"
    picture.unlink()
    elsewhere.rename(inside)
    picture.symlink_to(inside)
    (tmp_path / "link").symlink_to(data)
    assert len(load_photos(tmp_path / "link")) == 8


@pytest.mark.parametrize("key", ["file_path", "mask_path"])
@pytest.mark.parametrize("absolute", [False, True])
def test_paths_out_of_the_folder(data, tmp_path, monkeypatch, key, absolute):
    elsewhere = tmp_path / "p_009.png"
    write_png(elsewhere, np.full((8, 12, 4), 200, np.uint8))
    named = str(elsewhere) if absolute else "../p_009.png"
    edit(lambda r: r["frames"][0].update({key: named}))(data)
    with pytest.raises(
        DataError, match=r"frame 0: expected files inside .*data, got .*p_009\.png"
    ) as e:
        load_photos(data)
    assert e.value.arguments == ("allow_outside",)
    assert len(load_photos(data, allow_outside=True)) == 8
    inside = "masks/../images/p_009.png" if key == "file_path" else "images/../mask.png"
    write_png(data / "mask.png", np.full((8, 12), 255, np.uint8))
    edit(lambda r: r["frames"][0].update({key: inside}))(data)
    assert len(load_photos(data)) == 8


def test_names_of_colmap_out_of_the_folder(tmp_path):
    data = write_colmap(tmp_path / "data", scene(), text=True)
    (data / "images" / "p_004.png").rename(tmp_path / "p_004.png")
    images(("p_004.png", "../../p_004.png"))(data)
    with pytest.raises(DataError, match=r"images\.txt: expected files inside .*data, .*p_004\.png"):
        load_photos(data)


LAYOUTS = ["nerf", "nerfstudio", "colmap", "llff", "idr", "neilf", "polycam", "metashape"]
LAYOUTS += ["realitycapture", "tensoir"]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_cameras_that_are_a_link_out_of_the_folder(tmp_path, layout):
    """Messages quote what they cannot read: it has to be the data set's own."""
    getattr(layouts, f"write_{layout}")(tmp_path / "data", scene())
    data, elsewhere = tmp_path / "data", tmp_path / "elsewhere"
    elsewhere.mkdir()
    described = [p for p in data.rglob("*") if p.is_file() and p.suffix not in (".png", ".jpg")]
    assert described
    for number, path in enumerate(described):
        path.rename(elsewhere / f"{number}{path.suffix}")
        path.symlink_to(elsewhere / f"{number}{path.suffix}")
    with pytest.raises(DataError, match=r"expected files inside .*data, got .*elsewhere.*allow"):
        load_photos(data)
    assert len(load_photos(data, allow_outside=True)) == 8


@pytest.mark.parametrize(
    ("file_path", "file", "name"),
    [("..", "...png", ".."), ("images/..", "images/...png", ".."), ("_rgba.png", "_rgba.png", "")],
)
def test_names_that_mean_another_folder(data, file_path, file, name):
    """Results are written under the names of views: `relight` wrote OUT.png beside OUT."""
    edit(lambda r: r["frames"][1].update(file_path=file_path))(data)
    (data / "images" / "p_008.png").rename(data / file)
    message = f"frame 1: expected a name that is valid as a file name, got '{name}'"
    with pytest.raises(DataError, match=message):
        load_photos(data, "test")  # it is the first by name
    with pytest.raises(DataError, match=message):
        load_cameras(data / "transforms.json", 64)


@pytest.mark.parametrize("file_path", ["../../x.png", "/tmp/x", "a/../../x.exr"])
def test_names_of_views_are_those_of_files(data, file_path):
    """Whatever folders stand before them."""
    edit(lambda r: r["frames"][1].update(file_path=file_path))(data)
    names, _ = load_cameras(data / "transforms.json", 64)
    assert names[1] == "x"


def test_folders_in_names_of_colmap_become_part_of_them(tmp_path):
    data = write_colmap(tmp_path / "data", scene(), text=True)
    (data / "images" / "left").mkdir()
    (data / "images" / "p_004.png").rename(data / "images" / "left" / "p_004.png")
    mask = data / "masks" / "p_004.png.png"
    if mask.exists():
        (data / "masks" / "left").mkdir()
        mask.rename(data / "masks" / "left" / mask.name)
    images(("p_004.png", "left/../left/p_004.png"))(data)
    assert load_photos(data, "test").names[0] == "left_.._left_p_004"
