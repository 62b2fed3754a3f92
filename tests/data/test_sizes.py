"""Photographs of differing sizes and orientations, in the layouts that say so."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from layouts import (
    FOCAL,
    HEIGHT,
    WIDTH,
    replaced,
    save_turned,
    scene,
    write_colmap,
    write_nerfstudio,
)
from PIL import Image
from scipy.spatial.transform import Rotation

from univoxel.camera import project
from univoxel.data import load_cameras, load_photos
from univoxel.data.images import orientation, write_png
from univoxel.data.lens import Lens
from univoxel.data.load_images import Shot, upright
from univoxel.errors import DataError

LENS = Lens(4, 4, (4.0, 4.0), (2.0, 2.0))
# Of every third photograph: left out at the left and at the top
CUT = ((0, 0), (5, 0), (2, 3))


@pytest.fixture
def written():
    return scene(10)


def cut_files(folder, written, mask):
    """Cut photographs and masks; the size and the principal point [2] of each."""
    facts = {}
    for v, name in enumerate(written.names):
        x, y = CUT[v % 3]
        picture = written.pictures[v, y:, x:]
        write_png(folder / "images" / f"{name}.png", picture[..., :3])
        write_png(folder / "masks" / mask.format(name), picture[..., 3])
        facts[name] = (WIDTH - x, HEIGHT - y), (WIDTH / 2 - x, HEIGHT / 2 - y)
    return facts


def nerfstudio(folder, written):
    write_nerfstudio(folder, written)
    facts = cut_files(folder, written, "{}.png")
    file = folder / "transforms.json"
    root = json.loads(file.read_text())
    for frame in root["frames"]:
        (w, h), (cx, cy) = facts[frame["file_path"][7:-4]]
        frame |= {"w": w, "h": h, "cx": cx, "cy": cy}
    file.write_text(json.dumps(root))


def colmap(folder, written):
    write_colmap(folder, written, text=True)
    facts = cut_files(folder, written, "{}.png.png")
    lines, rows = [], (folder / "sparse/0/images.txt").read_text().splitlines()
    for number, (size, centre) in enumerate(dict.fromkeys(facts.values())):
        lines.append(f"{number} SIMPLE_PINHOLE {size[0]} {size[1]} {FOCAL} {centre[0]} {centre[1]}")
        for i, row in enumerate(rows):
            name = row.split()[-1].removesuffix(".png") if row.endswith("png") else None
            if facts.get(name) == (size, centre):
                head = row.split()[:-2]
                rows[i] = " ".join([*head, str(number), f"{name}.png"])
    (folder / "sparse/0/cameras.txt").write_text("\n".join(lines) + "\n")
    (folder / "sparse/0/images.txt").write_text("\n".join(rows) + "\n")


@pytest.mark.parametrize("write", [nerfstudio, colmap])
def test_the_same_points_are_seen_in_cut_photographs(tmp_path, written, write):
    write_nerfstudio(tmp_path / "whole", written)
    write(tmp_path / "cut", written)
    whole, cut = load_photos(tmp_path / "whole"), load_photos(tmp_path / "cut")
    assert cut.about.split(", ", 1)[1].startswith(
        "8 photographs of 7x8 (3), 12x8 (3) and 10x5 (2) pixels in train"
    )
    point = torch.tensor([[0.2, -0.1, 0.3]])
    for view, name in enumerate(cut.names):
        x, y = CUT[int(name[-3:]) % 3]
        assert cut.cameras.size(view) == (WIDTH - x, HEIGHT - y)
        color, alpha = cut.stored(view)
        assert torch.equal(color, whole.color[view, y:, x:])
        assert torch.equal(alpha, whole.alpha[view, y:, x:])
        found, wanted = (project(p.cameras, view, point)[0] for p in (cut, whole))
        torch.testing.assert_close(found + torch.tensor([x, y]), wanted)


def test_cameras_without_pictures_may_differ_in_size(tmp_path):
    frames = [
        {"file_path": f"{i}", "transform_matrix": np.eye(4).tolist(), "fl_x": 9.0} | size
        for i, size in enumerate([{"w": 4, "h": 6}, {}, {"w": 7}])
    ]
    path = tmp_path / "path.json"
    path.write_text(json.dumps({"h": 5, "frames": frames}))
    _, cameras = load_cameras(path, 8)
    assert cameras.size_of_each().tolist() == [[4, 6], [8, 5], [7, 5]]
    assert cameras.centre.tolist() == [[2, 3], [4, 2.5], [3.5, 2.5]]
    frames[2]["w"] = -7
    path.write_text(json.dumps({"frames": frames}))
    with pytest.raises(DataError, match=r"frame 2: expected w between 0 and 6\.554e\+04, got -7"):
        load_cameras(path, 8)


@pytest.fixture
def turned(tmp_path, written):
    """A COLMAP model of JPEG files that say that they are to be turned."""
    write_colmap(tmp_path, written, text=True)
    for v, name in enumerate(written.names):
        (tmp_path / "images" / f"{name}.png").unlink()
        gray = np.full((HEIGHT, WIDTH, 3), 20 * v, np.uint8)
        gray[:4] += 50
        save_turned(tmp_path / "images" / f"{name}.jpg", gray, 6)
        (tmp_path / "masks" / f"{name}.png.png").rename(tmp_path / "masks" / f"{name}.jpg.png")
    replaced("sparse/0/images.txt", (".png", ".jpg"))(tmp_path)
    return tmp_path


def test_pixels_are_those_of_the_file(turned):
    """COLMAP's cameras are: it does not look at EXIF's orientation."""
    photos = load_photos(turned)
    assert photos.cameras.size(0) == (WIDTH, HEIGHT)
    assert photos.color[0].float().std(1).max() < 4  # rows are of one colour
    assert photos.color[0, 0].float().mean() > photos.color[0, -1].float().mean() + 40


def test_messages_say_that_pixels_are_not_turned(turned):
    """Cameras of photographs as viewers show them."""
    note = "; the EXIF orientation 6 of p_001"
    replaced("sparse/0/cameras.txt", (f"{WIDTH} {HEIGHT}", f"{HEIGHT} {WIDTH}"))(turned)
    with pytest.raises(DataError, match=r"expected 8x12 pixels.*, got 12x8; the EXIF .* 6"):
        load_photos(turned)
    frames = [{"file_path": "images/p_001.jpg", "transform_matrix": np.eye(4).tolist()}]
    root = {"fl_x": FOCAL, "w": HEIGHT, "h": WIDTH, "frames": frames}
    (turned / "transforms.json").write_text(json.dumps(root))
    with pytest.raises(DataError, match=r"images of 8x12 pixels \(w and h\), got 12x8" + note):
        load_photos(turned)


# Quarter turns of the camera about its axis, counter-clockwise as seen from behind it, and what a
# phone then writes so that viewers show its picture upright
HELD = {1: 0, 8: 1, 3: 2, 6: 3}


def test_up_is_that_of_photographs_as_they_are_looked_at(tmp_path, written):
    """Held upright or across, each with its tag: the world is found as from level cameras."""
    turn = Rotation.from_rotvec([2.0, -0.5, 0.7])
    whole = scene(12).turned(turn)
    shots = []
    for v, name in enumerate(whole.names):
        tag = list(HELD)[v % 4]
        path = tmp_path / f"{name}.jpg"
        save_turned(path, np.zeros((4, 4, 3), np.uint8), tag)
        assert orientation(path) == tag
        held = Rotation.from_rotvec([0, 0, HELD[tag] * np.pi / 2]).as_matrix()
        pose = whole.poses[v, :3].copy()
        pose[:, :3] = pose[:, :3] @ held
        shots.append(Shot(name, "", path, None, pose, LENS))
    level = [
        replace(s, pose=whole.poses[v, :3], image=tmp_path / "none") for v, s in enumerate(shots)
    ]
    (found, said), (wanted, _) = upright(shots), upright(level)
    assert said == ["world rotated so that +Z is up"]
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_allclose(one.pose[:, 3], other.pose[:, 3], atol=1e-6)


def test_pictures_without_a_tag_are_as_they_are(tmp_path):
    write_png(tmp_path / "a.png", np.zeros((2, 2, 3), np.uint8))
    (tmp_path / "b.jpg").write_bytes(b"no picture")
    Image.new("RGB", (2, 2)).save(tmp_path / "c.jpg")
    save_turned(tmp_path / "d.jpg", np.zeros((2, 2, 3), np.uint8), 77)
    for name in ("a.png", "b.jpg", "c.jpg", "d.jpg", "none.jpg"):
        assert orientation(tmp_path / name) == 1
