"""Data sets that nobody made by mistake: files of others, names of other folders, bombs."""

import io
import zipfile
from functools import partial
from unittest.mock import Mock

import layouts
import numpy as np
import pytest
from layouts import edited, replaced, scene, write_colmap, write_nerfstudio

from univoxel.core.files import read_json
from univoxel.data import load_cameras, load_photos
from univoxel.data.images import write_png
from univoxel.data.path_sandbox import read_npy, read_npz
from univoxel.errors import DataError

edit, images = partial(edited, "transforms.json"), partial(replaced, "sparse/0/images.txt")


@pytest.fixture
def data(tmp_path):
    return write_nerfstudio(tmp_path / "data", scene())


def test_a_camera_path_is_as_small_as_files_hold(data):
    edit(lambda r: r.update(w=10**9))(data)
    with pytest.raises(DataError, match=r"expected w between 0 and 6.554e\+04, got 1000000000"):
        load_cameras(data / "transforms.json", 64)


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


@pytest.mark.parametrize("layout", ["nerf", "nerfstudio", "colmap", "tensoir"])
def test_links_out_of_the_folder(tmp_path, layout):
    """A picture that is a link to one elsewhere is read where its owner says so."""
    data = getattr(layouts, f"write_{layout}")(tmp_path / "data", scene())
    picture = min([*data.rglob("*p_001.png"), *data.rglob("train_000/*.png")])
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
    said = r"frame 0: expected files inside .*data, got .*p_009\.png"
    with pytest.raises(DataError, match=said) as e:
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


# Files of NumPy that cannot be read end in one line


def header(text):
    """A .npy file whose header says so."""
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


def archive(change):
    """A .npz file with bytes of its lists changed."""
    stream = io.BytesIO()
    np.savez(stream, a=np.ones(3))
    data = bytearray(stream.getvalue())
    for magic, offset, value in change:
        data[data.index(magic) + offset] = value
    return bytes(data)


SHAPE = "{'descr': '<f8', 'fortran_order': False, 'shape': (%s,)}\n"
LOCAL, CENTRAL = b"PK\x03\x04", b"PK\x01\x02"
NO_ARRAYS = [
    b"",
    b"text",
    header("{"),
    header(SHAPE % (10**30)),
    header(SHAPE % 7),
    header("[1]\n"),
]
NO_ARCHIVES = [
    *(b"", b"text"),
    archive([(LOCAL, 8, 99), (CENTRAL, 10, 99)]),  # packed by no known method
    archive([(LOCAL, 6, 1), (CENTRAL, 8, 1)]),  # encrypted
    archive([(b"NUMPY", 60, 7)]),  # of another checksum
]


def test_files_that_are_none(tmp_path):
    array, npz = tmp_path / "a.npy", tmp_path / "a.npz"
    with pytest.raises(DataError, match="this NumPy array could not be read"):
        read_npy(array)
    for content in NO_ARRAYS:
        array.write_bytes(content)
        with pytest.raises(DataError, match=r"a\.npy: this NumPy array could not be read"):
            read_npy(array)
    for content in NO_ARCHIVES:
        npz.write_bytes(content)
        with pytest.raises(DataError, match=r"a\.npz: this npz file could not be read"):
            read_npz(npz)
    np.savez(npz, a=np.ones(3))
    with pytest.raises(DataError, match="expected one NumPy array, got an archive of several"):
        read_npy(npz)


def test_arrays_of_another_prefix_are_not_looked_at(tmp_path):
    np.savez(tmp_path / "a.npz", mat_0=np.ones(2), other=np.array([{}], object))
    assert list(read_npz(tmp_path / "a.npz", "mat_")) == ["mat_0"]
    with zipfile.ZipFile(tmp_path / "a.npz") as file:
        assert len(file.namelist()) == 2
