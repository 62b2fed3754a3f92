"""From photographs as they come to cameras: runs of structure from motion on a made scene."""

import json
import os
import shutil
import sqlite3
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pillow_heif
import pytest
import textured_room
from PIL import Image

import univoxel
from univoxel.capture import model as database
from univoxel.capture import poses as poses_task
from univoxel.capture import sfm, structure
from univoxel.capture.config import CaptureConfig
from univoxel.capture.model import NO_POINT, read_model
from univoxel.capture.photographs import find_photographs
from univoxel.capture.poses import poses
from univoxel.capture.prepare import Folders, gather
from univoxel.core import files, log
from univoxel.data.colmap import read_cameras, read_images
from univoxel.errors import DataError, ExistingFile, MissingExtra, ProcessFailed

# Enough for pictures of this size, and pairs are chosen as in large sets
SMALL = CaptureConfig(features=1000, first_octave=0, exhaustive=10, partners=8)
VIEWS, WIDTH, HEIGHT = 24, 400, 300
ZOOMED = range(18, 24)  # views with another zoom setting
MODEL, FOCAL, FOCAL_35MM, EXIF_WIDTH, EXIF_HEIGHT = 0x110, 0x920A, 0xA405, 0xA002, 0xA003
FOCAL_OF_35MM = np.hypot(36, 24) / 1.25  # of pictures of 4:3 whose focal length is their width


def _exif(zoom: float, orientation: int, width: int, height: int) -> Image.Exif:
    exif = Image.Exif()
    exif[MODEL], exif[0x112] = "Phone", orientation
    exif.get_ifd(0x8769).update(
        {
            FOCAL: 5.0 * zoom,
            FOCAL_35MM: round(FOCAL_OF_35MM * zoom),
            EXIF_WIDTH: width,
            EXIF_HEIGHT: height,
        }
    )
    return exif


def _view(v: int) -> textured_room.View:
    """Every fourth view is held upright, the last ones are zoomed."""
    upright = v % 4 == 1
    size = (HEIGHT, WIDTH) if upright else (WIDTH, HEIGHT)
    return textured_room.orbit(VIEWS, *size, focal=1.3 if v in ZOOMED else 1.0)[v]


@pytest.fixture(scope="module")
def photographs(tmp_path_factory) -> Path:
    """What a phone and its owner leave behind: formats, turns, zooms, and what is no use."""
    folder = tmp_path_factory.mktemp("photographs")
    for v in range(VIEWS):
        view = _view(v)
        picture, _ = textured_room.photograph(view, samples=2)
        zoom = 1.3 if v in ZOOMED else 1.0
        if v % 4 == 1:  # stored lying, as sensors are read out
            picture = picture.transpose(Image.Transpose.ROTATE_90)
        exif = _exif(zoom, 6 if v % 4 == 1 else 1, *picture.size)
        path = folder / f"IMG {v:02d}.jpg"
        if v % 3 == 2:
            heif = pillow_heif.from_pillow(picture)
            heif.save(path.with_suffix(".heic"), quality=90, exif=exif.tobytes())
        else:
            picture.save(path, quality=92, exif=exif)
    Image.new("RGB", (WIDTH, HEIGHT), "white").save(
        folder / "white.jpg", exif=_exif(1, 1, 400, 300)
    )
    (folder / "notes.txt").write_text("taken in the kitchen")
    (folder / "broken.jpg").write_bytes((folder / "IMG 00.jpg").read_bytes()[:500])
    return folder


@pytest.fixture(scope="module")
def scene(photographs, tmp_path_factory) -> tuple[Path, list[str]]:
    said, out = [], tmp_path_factory.mktemp("out") / "scene"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(log, "isEnabledFor", lambda level: True)
        patch.setattr(log, "handle", lambda record: said.append(record.getMessage()))
        poses(photographs, out, config=SMALL)
    return out, said


def aligned(out: Path, views: dict[int, textured_room.View]) -> tuple[np.ndarray, np.ndarray]:
    """Errors of centres, world units, and of rotations, degrees, after a similarity."""
    found = {int(i.name.split()[1][:2]): i.pose for i in read_images(out / "sparse/0/images.bin")}
    assert sorted(found) == sorted(views)
    ours = np.stack([found[v] for v in sorted(found)])
    true = np.stack([views[v].pose for v in sorted(found)])
    a, b = ours[:, :, 3] - ours[:, :, 3].mean(0), true[:, :, 3] - true[:, :, 3].mean(0)
    u, s, v = np.linalg.svd(b.T @ a)
    mirror = np.diag([1, 1, np.linalg.det(u @ v)])
    turn = u @ mirror @ v
    scale = (s * mirror.diagonal()).sum() / (a**2).sum()
    left = np.einsum("vij,vkj->vik", turn @ ours[:, :, :3], true[:, :, :3])
    cosine = (np.trace(left, axis1=1, axis2=2) - 1) / 2
    return np.linalg.norm(scale * a @ turn.T - b, axis=1), np.degrees(np.arccos(cosine.clip(-1, 1)))


def test_photographs_as_they_come_are_placed(scene):
    out, _ = scene
    centres, degrees = aligned(out, {v: _view(v) for v in range(VIEWS)})
    assert centres.max() < 0.01 * 2.2  # of the orbit's radius
    assert degrees.max() < 0.2


def test_pictures_are_upright_and_fit_their_cameras(scene):
    """And what they see of the points is where the cameras project them."""
    out, _ = scene
    model = read_model(out / "sparse/0")
    position = dict(zip(model.points.number.tolist(), model.points.position, strict=True))
    for image in model.images:
        lens, seen = model.cameras[image.camera], image.point != NO_POINT
        points = np.stack([position[p] for p in image.point[seen].tolist()])
        x, y, z = image.to_camera[:, :3] @ points.T + image.to_camera[:, 3:]
        found = np.stack(lens.seen(x / z, y / z), -1)
        assert np.median(np.linalg.norm(found - image.xy[seen], axis=1)) < 1  # pixel
    lenses = read_cameras(out / "sparse/0/cameras.bin")
    assert len(lenses) == 4  # two zooms, held both ways
    for image in read_images(out / "sparse/0/images.bin"):
        v, lens = int(image.name.split()[1][:2]), lenses[image.camera]
        with Image.open(out / "images" / image.name) as picture:
            assert picture.size == (lens.width, lens.height) == (_view(v).width, _view(v).height)
            assert not dict(picture.getexif())
        # The zoom is solved for within a percent: distortion and focal length trade a little
        assert lens.focal[0] == pytest.approx(400 * _view(v).focal, rel=0.01)
        assert lens.centre == (lens.width / 2, lens.height / 2)


def test_the_world_is_upright_around_the_object(scene):
    out, _ = scene
    pose = np.stack([i.pose for i in read_images(out / "sparse/0/images.bin")])
    true = np.stack([_view(v).pose for v in range(VIEWS)])
    np.testing.assert_allclose(pose[:, 2, :3], true[:, 2, :3], atol=0.01)  # heights of all axes
    assert np.median(np.linalg.norm(pose[:, :, 3], axis=1)) == pytest.approx(4)
    first = next(i for i in read_images(out / "sparse/0/images.bin") if i.name == "IMG 00.jpg")
    assert first.pose[0, 3] == pytest.approx(0, abs=1e-6)
    assert first.pose[1, 3] < 0


def test_what_is_left_out_is_named(scene):
    out, said = scene
    assert f"{VIEWS + 1} photographs from 2 cameras (2 zoom settings)" in said[0]
    assert "2 could not be read: broken.jpg, notes.txt" in said[0]
    assert any(f"{VIEWS} of {VIEWS + 1} photographs registered" in line for line in said)
    assert any("white.jpg (no features that can be matched)" in line for line in said)
    report = json.loads((out / "poses.json").read_text())
    rows = {row["name"]: row for row in report["photographs"]}
    assert rows["white.jpg"]["written"] == ""
    assert not rows["white.jpg"]["placed"]
    assert rows["IMG 02.heic"]["written"] == "IMG 02.jpg"
    assert all(row["points"] > 100 for name, row in rows.items() if name != "white.jpg")
    assert report["error"] < 1


def test_the_same_again_is_done_and_other_settings_are_refused(scene, photographs, monkeypatch):
    out, _ = scene
    monkeypatch.setattr(subprocess, "Popen", None)  # nothing may be run
    before = (out / "poses.json").stat().st_mtime_ns
    assert poses(photographs, out, config=SMALL) == out
    assert (out / "poses.json").stat().st_mtime_ns == before
    with pytest.raises(ExistingFile, match="contains another scene"):
        poses(photographs, out)


def test_a_search_goes_on_from_what_is_there(scene, photographs, tmp_path, monkeypatch):
    """Killed while it wrote: the same command only writes."""
    out, _ = scene
    again = tmp_path / "again"
    shutil.copytree(out / "sfm", again / "sfm")
    (again / "images").mkdir()
    (again / "images" / "half.jpg").touch()
    monkeypatch.setattr(subprocess, "Popen", None)  # nothing may be run
    poses(photographs, again, keep_size=200, config=SMALL)
    assert not (again / "images" / "half.jpg").exists()
    with Image.open(again / "images" / "IMG 00.jpg") as picture:
        assert picture.size == (200, 150)
    lenses = read_cameras(again / "sparse/0/cameras.bin").values()
    assert {max(lens.width, lens.height) for lens in lenses} == {200}
    centres, _ = aligned(again, {v: _view(v) for v in range(VIEWS)})
    assert centres.max() < 0.01 * 2.2


def as_of_0_2(work: Path) -> None:
    """Put the notes of version 0.2 in the place of ours."""
    settings = files.recorded(work, "search")
    settings["config"] |= poses_task.CONSTANTS_0_2
    (work / "request.json").write_text(json.dumps(settings))
    for name in ("matched", "models/done"):
        (work / name).touch()
    (work / files.FILE).unlink()


def test_a_search_of_version_0_2_is_gone_on_with(scene, photographs, tmp_path, monkeypatch):
    out, _ = scene
    before, begun = tmp_path / "before", tmp_path / "begun"
    shutil.copytree(out, before)
    shutil.copytree(out / "sfm", begun / "sfm")
    for folder in (before, begun):
        as_of_0_2(folder / "sfm")
    (begun / "sfm/models/done").unlink()
    ran, run = [], structure.run
    monkeypatch.setattr(structure, "run", lambda r, *rest: ran.append(r.step) or run(r, *rest))
    images = (before / "sparse/0/images.bin").stat().st_mtime_ns
    poses(photographs, before, config=SMALL)
    assert ran == []
    assert (before / "sparse/0/images.bin").stat().st_mtime_ns == images
    with pytest.raises(ExistingFile, match="contains another scene"):
        poses(photographs, before)
    poses(photographs, begun, config=SMALL)
    assert ran == ["map"]
    centres, _ = aligned(begun, {v: _view(v) for v in range(VIEWS)})
    assert centres.max() < 0.01 * 2.2


@pytest.mark.parametrize("older", [False, True])
def test_an_unfinished_search_with_other_settings_begins_anew(
    scene, photographs, tmp_path, monkeypatch, older
):
    work = tmp_path / "sfm"
    shutil.copytree(scene[0] / "sfm", work)
    if older:
        as_of_0_2(work)
    monkeypatch.setattr(subprocess, "Popen", None)
    with pytest.raises(TypeError):  # it is about to find features
        poses(photographs, tmp_path, config=replace(SMALL, features=500))
    assert not (work / "database.db").exists()
    assert not (work / "models").exists()
    assert files.recorded(work, "search")["config"]["features"] == 500
    assert files.recorded(work, "matching") is None


def test_features_are_found_once_in_the_camera_that_was_begun(scene, photographs, tmp_path):
    """Killed while features were sought: the rest joins the cameras that are there."""
    out, _ = scene
    folders = Folders(tmp_path / "sfm")
    shutil.copytree(out / "sfm" / "pictures", folders.pictures)
    files, _, _ = find_photographs(photographs)
    capture, _ = gather(files, None)
    later = [folders.pictures / capture.pictures[i] for i in (2, 3, 20)]
    for path in later:
        path.rename(path.with_suffix(".later"))
    list(structure.extract(capture, folders, SMALL))
    begun = database.images(folders.database)
    assert len(begun) == VIEWS + 1 - 3
    for path in later:
        path.with_suffix(".later").rename(path)
    list(structure.extract(capture, folders, SMALL))
    found = database.images(folders.database)
    assert len(found) == VIEWS + 1
    assert begun.items() <= found.items()
    assert len({camera for _, camera in found.values()}) == 2
    whole = database.images(out / "sfm" / "database.db")
    counts = database.feature_counts(folders.database)
    expected = database.feature_counts(out / "sfm" / "database.db")
    for name, (number, _) in found.items():
        assert counts[number] == expected[whole[name][0]]


@pytest.fixture(scope="module")
def turntable(tmp_path_factory) -> Path:
    """A still camera before an object that is turned, in front of a wall of its own pattern."""
    folder = tmp_path_factory.mktemp("turntable")
    (folder / "masks").mkdir()
    for v in range(14):
        view = textured_room.orbit(14, WIDTH, HEIGHT, focal=1.4)[0]
        picture, mask = textured_room.photograph(view, 2, turn=np.pi / 14 * v, still=True)
        picture.save(folder / f"IMG {v:02d}.png")
        mask.resize((WIDTH // 2, HEIGHT // 2)).save(folder / "masks" / f"IMG {v:02d}.png")
    return folder


def test_a_turntable_is_recognised_before_mapping(turntable, tmp_path):
    with pytest.raises(DataError, match=r"background is static in \d+ of \d+ pairs.*masks=DIR"):
        poses(turntable, tmp_path / "out", config=SMALL)
    assert not (tmp_path / "out/sfm/models").exists()
    assert not (tmp_path / "out/images").exists()


def test_a_turntable_with_masks_is_placed(turntable, tmp_path):
    fine = replace(SMALL, first_octave=-1, exhaustive=20)  # there is less to hold on to
    poses(turntable, tmp_path / "out", masks=turntable / "masks", config=fine)
    views = {}
    for v in range(14):
        view = textured_room.orbit(14)[0]
        c, s = np.cos(np.pi / 14 * v), np.sin(np.pi / 14 * v)
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        views[v] = textured_room.View(turn @ view.pose, 1.4, WIDTH, HEIGHT)
    centres, degrees = aligned(tmp_path / "out", views)
    assert centres.max() < 0.01 * 2.2
    # An object in a third of a small picture says less than a whole room, and little of the focal
    # length: 0.4 degrees, where matches across the background would be off by tens of degrees
    assert degrees.max() < 1
    with Image.open(tmp_path / "out/masks/IMG 03.png.png") as mask:
        assert mask.size == (WIDTH, HEIGHT)


def test_too_few_placed_is_one_line(photographs, tmp_path):
    """From opposite sides, and pictures of nothing."""
    folder = tmp_path / "in"
    folder.mkdir()
    for v in (0, 12):
        shutil.copy(photographs / f"IMG {v:02d}.jpg", folder)
    for k in range(4):
        Image.new("RGB", (WIDTH, HEIGHT), (60 * k, 0, 0)).save(folder / f"plain{k}.png")
    with pytest.raises(DataError, match=r"only \d of 6 photographs were registered.*plain0.png"):
        poses(folder, tmp_path / "out", config=SMALL)
    assert not (tmp_path / "out/images").exists()


def test_what_cannot_be_begun_is_one_line(tmp_path, monkeypatch):
    with pytest.raises(DataError, match="expected a folder of photographs or a video"):
        poses(tmp_path / "none", tmp_path / "out")
    with pytest.raises(DataError, match="every applies only to videos"):
        poses(tmp_path, tmp_path / "out", every=1.0)
    for name in "ab":
        Image.new("RGB", (64, 48)).save(tmp_path / f"{name}.jpg")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").touch()
    with pytest.raises(ExistingFile, match=r"contains other files \(mine.txt\)"):
        poses(tmp_path, tmp_path / "out")
    monkeypatch.setattr(sfm.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingExtra, match=r"pip install 'univoxel\[capture\]'"):
        poses(tmp_path / "not there", tmp_path / "other")
    assert not (tmp_path / "other").exists()


def pycolmap_that(does: str, folder: Path) -> str:
    """PYTHONPATH of a stand-in for the package, which does something when a step imports it."""
    (folder / "pycolmap.py").write_text(does)
    return os.pathsep.join([str(folder), str(Path(univoxel.__file__).parents[1])])


def test_a_step_that_fails_or_hangs_is_stopped(tmp_path, monkeypatch):
    request = sfm.Request("match", str(tmp_path / "none.db"), "", "", seconds=0.1)
    log = tmp_path / "match.log"
    with pytest.raises(ProcessFailed, match=r"match: pycolmap failed .*match.log"):
        list(sfm.run(sfm.Request("match", "/", "/", "/"), log, lambda: 0))
    path = pycolmap_that("import time; time.sleep(60)", tmp_path)
    monkeypatch.setenv("PYTHONPATH", path)
    with pytest.raises(ProcessFailed, match="pycolmap was stopped after 0 s"):
        list(sfm.run(request, log, lambda: 0))


ALONE = """
import sys
from pathlib import Path
from univoxel.capture import sfm
list(sfm.run(sfm.Request("match", "/", "/", "/"), Path(sys.argv[1])))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="needs prctl")
def test_a_step_ends_with_who_began_it(tmp_path, monkeypatch):
    """Killed, it would otherwise go on alone, beside the step that is begun again."""
    log = tmp_path / "match.log"
    log.touch()
    path = pycolmap_that(
        "import os, time; print(os.getpid(), flush=True); time.sleep(60)", tmp_path
    )
    monkeypatch.setenv("PYTHONPATH", path)
    with subprocess.Popen([sys.executable, "-c", ALONE, log]) as parent:
        while not log.read_text().endswith("\n"):
            assert parent.poll() is None
            time.sleep(0.05)
        running = Path("/proc") / log.read_text().strip()
        assert running.exists()
        parent.kill()
    for _ in range(600):  # it ends in an instant, on a machine with nothing else to do
        try:
            ended = "\nState:\tZ" in (running / "status").read_text()
        except (FileNotFoundError, ProcessLookupError):
            ended = True
        if ended:
            return
        time.sleep(0.05)
    pytest.fail("the step goes on")


def test_pycolmap_stays_out_of_this_process():
    code = (
        "import sys, univoxel, univoxel.cli, univoxel.capture.poses, univoxel.capture.sfm\n"
        "assert 'pycolmap' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_database_is_read_as_it_is_written(scene):
    """Against SQLite's own account of it."""
    path = scene[0] / "sfm" / "database.db"
    with sqlite3.connect(path) as db:
        keys = {name: number for number, name in db.execute("SELECT image_id, name FROM images")}
    assert {n: i for n, (i, _) in database.images(path).items()} == keys
    assert database.count(path, "keypoints") == len(keys) == VIEWS + 1
    features = database.largest_features(path, next(iter(keys.values())), 50)
    assert features.shape == (50, 128)
    np.testing.assert_allclose(np.linalg.norm(features, axis=1), 1, rtol=1e-5)
    places = database.positions(path)
    assert {n: len(xy) for n, xy in places.items()} == database.feature_counts(path)
    assert all((xy >= 0).all() and (xy <= 1200).all() for xy in places.values())
    pairs = list(database.matches(path))
    counted = {(a, b): n for a, b, n, _ in database.verified_pairs(path) if n}
    assert {(p.first, p.second): len(p.matches) for p in pairs} == counted
    for pair in pairs:
        for number, features in zip((pair.first, pair.second), pair.matches.T, strict=True):
            assert features.max() < len(places[number])
