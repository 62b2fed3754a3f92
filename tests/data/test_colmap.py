"""COLMAP's models: where they lie, and errors."""

import struct
import subprocess
import sys
from functools import partial

import numpy as np
import pytest
import torch
from layouts import HEIGHT, WIDTH, refused, replaced, scene, write_colmap

from univoxel.data import load_photos
from univoxel.data.images import write_png
from univoxel.errors import DataError


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0", "."])
def test_places(tmp_path, place, text):
    photos = load_photos(write_colmap(tmp_path, scene(), place, text), "test")
    assert photos.names == ["p_000", "p_008"]


@pytest.mark.parametrize("form", ["binary", "text"])
def test_models_that_colmap_itself_writes(tmp_path, form):
    """With rigs and frames beside, as it has them since 3.12; of one and the same model."""
    pytest.importorskip("pycolmap")
    data = write_colmap(tmp_path, scene(), text=True)
    model, plain = data / "sparse/0", load_photos(data)
    (model / "points3D.txt").touch()
    program = (
        "import sys, zlib, pycolmap; from pathlib import Path; model = Path(sys.argv[1])\n"
        "read = pycolmap.Reconstruction(model)\n"
        "for file in model.iterdir(): file.unlink()\n"
        f"read.write_{form}(model)"
    )
    subprocess.run([sys.executable, "-c", program, model], check=True)  # never beside torch
    assert len(list(model.glob({"binary": "*.bin", "text": "*.txt"}[form]))) >= 3
    photos = load_photos(data)
    assert photos.names == plain.names
    torch.testing.assert_close(photos.cameras.camera_to_world, plain.cameras.camera_to_world)
    torch.testing.assert_close(photos.cameras.focal, plain.cameras.focal)


def test_binary_files_come_first(tmp_path):
    write_colmap(tmp_path, scene())
    write_colmap(tmp_path, scene(3), text=True)
    assert len(load_photos(tmp_path)) == 8


def test_photographs_in_folders_and_names_with_spaces(tmp_path):
    write_colmap(tmp_path, scene(2), text=True)
    for part, ending in (("images", ".png"), ("masks", ".png.png")):
        (tmp_path / part / "a b").mkdir()
        for v in range(2):
            path = tmp_path / part / f"p_00{v}{ending}"
            path.rename(tmp_path / part / "a b" / f"p {v}{ending}")
    images(("p_00", "a b/p "))(tmp_path)
    assert load_photos(tmp_path, "test").names == ["a b_p 0"]


cameras, images = (partial(replaced, f"sparse/0/{name}.txt") for name in ("cameras", "images"))


def other_text(text):
    return lambda folder: (folder / "sparse/0/images.txt").write_text(text)


def cut(name, keep):
    def apply(folder):
        path = folder / "sparse" / "0" / name
        path.write_bytes(path.read_bytes()[:keep])

    return apply


def other_size(wider, higher):
    picture = np.ones((HEIGHT + higher, WIDTH + wider, 3), np.uint8)
    return lambda folder: write_png(folder / "images" / "p_004.png", picture)


TEXT = {
    "fisheye": (
        cameras(("SIMPLE_PINHOLE", "OPENCV_FISHEYE")),
        r"cameras\.txt: expected .* SIMPLE_PINHOLE, .*, got OPENCV_FISHEYE for camera 3: run",
    ),
    "parameters": (
        cameras(("SIMPLE_PINHOLE", "PINHOLE")),
        r"cameras\.txt: this file .*: camera 3: 3 parameters do not fit model PINHOLE",
    ),
    "words": (cameras(("11.0", "wide")), r"cameras\.txt: this file .* 'wide'"),
    "focal length": (
        cameras(("11.0", "-11.0")),
        r"cameras\.txt: .*: expected focal lengths from 0\.006 to 1\.2e\+06 pixels .*, got -11",
    ),
    "camera": (
        images((" 3 p_004", " 9 p_004")),
        r"images\.txt: p_004\.png refers to missing camera 9",
    ),
    "line": (images((" 3 p_004.png", "")), r"images\.txt: this file of a COLMAP model"),
    "nothing": (other_text("# none\n"), r"images\.txt: expected photographs w"),
    "quaternion": (
        other_text("1 0 0 0 0 1 2 3 3 p_000.png\n"),
        r"images\.txt: .* the pose of p_000\.png is",
    ),
    "no picture": (
        lambda f: [(f / "images" / f"p_00{v}.png").unlink() for v in range(1, 9)],
        r"images\.txt: missing images: p_008\.png, .* \(8 of 10\)",
    ),
    "no pictures": (
        lambda f: (f / "images").rename(f / "photos"),
        r"images\.txt: missing images: p_009\.png, .* \(10 of 10\).*looked in .*images and ",
    ),
    "size": (other_size(1, 0), r"p_004\.png: expected 12x8 pixels, the size of .*, got 13x8"),
    "height": (other_size(0, 1), r"p_004\.png: expected 12x8 pixels, the size of .*, got 12x9"),
}
BINARY = {
    "cut cameras": (cut("cameras.bin", 30), r"cameras\.bin: this file of a COLMAP model"),
    "empty": (cut("cameras.bin", 0), r"cameras\.bin: this file of a COLMAP model"),
    "cut name": (cut("images.bin", 76), r"images\.bin: this file of a COLMAP model"),
    "cut points": (cut("images.bin", -3), r"images\.bin: this file of a COLMAP model"),
}


@pytest.mark.parametrize("case", [*TEXT, *BINARY])
def test_broken_models(tmp_path, case):
    change, message = (TEXT | BINARY)[case]
    refused(write_colmap(tmp_path, scene(), text=case in TEXT), change, message)


@pytest.mark.parametrize(("number", "name"), [(7, "FOV"), (99, "model 99")])
def test_models_that_are_not_supported(tmp_path, number, name):
    write_colmap(tmp_path, scene())
    data = struct.pack("<Q", 1) + struct.pack("<iiQQ", 3, number, WIDTH, HEIGHT) + bytes(80)
    (tmp_path / "sparse" / "0" / "cameras.bin").write_bytes(data)
    with pytest.raises(DataError, match=f"got {name} for camera 3: run colmap"):
        load_photos(tmp_path)


@pytest.mark.parametrize("text", [True, False])
def test_of_several_models_the_largest_is_read(tmp_path, text):
    """COLMAP's first try may have placed two photographs, and wrongly."""
    two, all_views = scene(2), scene(10)
    write_colmap(tmp_path, two, place="sparse/0", text=text)
    write_colmap(tmp_path, all_views, place="sparse/1", text=text)
    photos = load_photos(tmp_path)
    assert len(photos) == 8
    assert "sparse/1, the largest of 2 models" in photos.about
