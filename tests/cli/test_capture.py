"""From photographs to a page in one go: what is made, kept, taken from the user, refused."""

import json
import logging
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import capturing
import numpy as np
import pytest
import textured_room
from PIL import Image

import univoxel
from univoxel.capture import poses as structure_from_motion
from univoxel.cli import capture as task
from univoxel.errors import (
    DataError,
    ExistingFile,
    MissingExtra,
    StillBackground,
    UserError,
    WithoutMasks,
)

USUAL = ("u2netp", None, False)  # of options of cutout
VIEWS = 11  # of 36 around the object: too few for a vote, so masks are taken as they are


@pytest.fixture(scope="module")
def photographs(tmp_path_factory) -> tuple[Path, Path]:
    """Photographs, and their masks in another folder."""
    root = tmp_path_factory.mktemp("given")
    for name in ("photos", "masks"):
        (root / name).mkdir()
    for v, view in enumerate(textured_room.orbit(36, 400, 300)[:VIEWS]):
        picture, mask = textured_room.photograph(view)
        picture.save(root / "photos" / f"IMG_{v:02d}.jpg", quality=92)
        mask.save(root / "masks" / f"IMG_{v:02d}.png")
    return root / "photos", root / "masks"


@pytest.fixture(scope="module")
def captured(photographs, tmp_path_factory) -> task.Captured:
    return capturing.make(photographs, tmp_path_factory.mktemp("out") / "mug")


def files_of(out: Path) -> dict[str, int]:
    """Files below a folder, but for those of the search for cameras, which need not stay."""
    return {
        path.relative_to(out).as_posix(): path.stat().st_mtime_ns
        for path in sorted(out.rglob("*"))
        if path.is_file() and "sfm" not in path.parts
    }


def test_photographs_become_a_mesh_and_a_page(captured):
    out = captured.page.parent
    assert captured == task.Captured(out / "index.html", out / "mug.glb", out / "run")
    assert captured.mesh.read_bytes()[:4] == b"glTF"
    files = files_of(out)
    for name in ("scene/sparse/0/images.bin", "scene/images/IMG_00.jpg", "cut/masks.html"):
        assert name in files
    for name in ("city", "sunset"):
        for frame in range(capturing.PICTURES.frames):
            with Image.open(out / "pictures" / name / f"orbit_{frame:04d}.png") as picture:
                assert picture.size == (48, 48)
    page = captured.page.read_text("utf-8")
    assert "(mug.glb)" in page
    assert "(cut/masks.html)" in page
    assert "Made from " in page
    assert "novel views, PSNR" in page
    assert univoxel.open_run(captured.run).path == captured.run


def test_the_same_again_only_says_what_is_there(captured, photographs, caplog):
    out = captured.page.parent
    before = files_of(out)
    with caplog.at_level(logging.INFO, "univoxel"):
        capturing.make(photographs, out)
    said = [r.getMessage() for r in caplog.records]
    there = ("cameras", "masks", "training", "mesh", "pictures")
    for n, step in enumerate(there, 1):
        assert said[n - 1].startswith(f"step {n} of 6, {step}: already done, see {out}")
    assert said[5] == f"step 6 of 6, page: {out}/index.html"
    assert all(line.startswith("mesh: ") for line in said[6:])  # of the page's
    after = files_of(out)
    assert after.pop("index.html") >= before.pop("index.html")
    assert after == before
    edited = next((out / "cut" / "train").glob("*.png"))  # a mask that was mended is told
    times = edited.stat().st_atime_ns, edited.stat().st_mtime_ns
    os.utime(edited)
    capturing.make(photographs, out)
    os.utime(edited, ns=times)
    assert f"{(out / 'cut').absolute()} has changed" in caplog.text


def test_killed_in_each_step_the_same_call_goes_on(captured, photographs, tmp_path):
    out = tmp_path / "mug"
    command = [sys.executable, capturing.__file__, *photographs, out]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    told = [json.loads(line) for line in ended.stdout.splitlines()]
    assert [step for step, _, _ in told] == list(task.STEPS)
    made = ("scene/poses.json", "cut/masks.html", "run/trust.txt", "mug.glb")
    made += ("pictures/measures.json", "index.html")
    for n, (step, ended_by, files) in enumerate(told):
        assert ended_by == signal.SIGKILL, (step, ended.stderr)
        assert {*made[:n]} <= {*files}
        assert not {*made[n:]} & {*files}  # not whole, so not there
        if step == "training":  # it goes on from there
            assert "run/scene.safetensors" in files
    finished = capturing.make(photographs, out)
    reference = captured.page.parent
    assert finished.mesh == out / "mug.glb"
    # Nothing half-written among them; the log is there where training took seconds
    assert (files_of(out).keys() ^ files_of(reference).keys()) <= {"run/log.jsonl"}
    # What does not hang on how long training took is the same to the bit
    for name in files_of(out):
        if name.startswith(("scene/images/", "scene/sparse/", "cut/")):
            assert (out / name).read_bytes() == (reference / name).read_bytes(), name


def test_other_photographs_are_refused(captured, photographs, tmp_path):
    out, (photos, masks) = captured.page.parent, photographs
    before = files_of(out)
    more, fewer, other = (tmp_path / name for name in ("more", "fewer", "other"))
    for folder in (more, fewer, other):
        shutil.copytree(photos, folder)
    shutil.copy(photos / "IMG_00.jpg", more / "IMG_99.jpg")
    (fewer / "IMG_03.jpg").unlink()
    with (other / "IMG_04.jpg").open("ab") as file:
        file.write(b"\0")
    for folder, why in (
        (more, "IMG_99.jpg is new"),
        (fewer, "IMG_03.jpg is missing"),
        (other, "IMG_04.jpg has changed"),
    ):
        with pytest.raises(ExistingFile, match=f"contains a capture of IMG_00.jpg and 10 .*{why}"):
            capturing.make((folder, masks), out)
    moved = tmp_path / "moved"
    shutil.copytree(photos, moved)  # the same photographs elsewhere
    capturing.make((moved, masks), out)
    before.pop("index.html")
    assert before.items() <= files_of(out).items()


def test_what_other_options_made_is_refused(captured, photographs):
    out, (photos, masks) = captured.page.parent, photographs
    options: dict[str, Any] = {"config": capturing.CONFIG, "pictures": capturing.PICTURES}
    with pytest.raises(ExistingFile, match=r"cut was made with masks=.*remove this folder and"):
        task.capture(photos, out, **options)
    options |= {"masks": masks, "changes": capturing.CHANGES}
    choices: list[dict[str, Any]] = [
        {"preset": "full", "light": "baked"},
        {"preset": "draft", "light": "sg"},
        {"preset": "draft", "light": "baked", "minutes": 3.0},
    ]
    for choice in choices:
        with pytest.raises(ExistingFile, match=r"run was trained with other values of preset"):
            task.capture(photos, out, **options, **choice)


def test_a_newer_run_makes_mesh_and_pictures_anew(captured, photographs, tmp_path, monkeypatch):
    """As where it was trained on: what is older than it is of another state."""
    out = tmp_path / "mug"
    shutil.copytree(captured.page.parent, out)
    os.utime(out / "run" / "scene.safetensors")
    os.utime(out / "run" / "trust.txt")
    called = []
    monkeypatch.setattr(task, "_check_trained", lambda *_: None)
    monkeypatch.setattr(task, "export", lambda run, mesh: called.append("export"))
    monkeypatch.setattr(task, "relight_to_files", lambda *_, **__: called.append("relight"))

    def measures(run, save, json):
        called.append("evaluate")
        raise DataError("photographs are elsewhere")

    monkeypatch.setattr(task, "evaluate", measures)
    assert not list((out / "pictures").rglob("*.xyz"))
    capturing.make(photographs, out)
    assert called == ["export", "relight", "evaluate"]
    assert not any(p.is_file() for p in (out / "pictures").rglob("*"))
    assert "novel views, PSNR" not in (out / "index.html").read_text("utf-8")


def test_a_run_takes_the_place_of_three_steps(captured, tmp_path, caplog):
    with caplog.at_level(logging.INFO, "univoxel"):
        made = task.capture(captured.run, tmp_path / "again", pictures=capturing.PICTURES)
    assert made.run == captured.run
    assert made.mesh.read_bytes()[:4] == b"glTF"
    assert {p.name for p in made.page.parent.iterdir()} == {
        *("again.glb", "steps.json", "index.html", "pictures")
    }
    assert f"step 3 of 6, training: already done, see {captured.run}" in caplog.text
    with pytest.raises(UserError, match="is a trained run: leave out masks, network, box, preset"):
        task.capture(captured.run, tmp_path / "other", minutes=2.0)
    with pytest.raises(UserError, match="is a trained run: leave out masks"):
        task.capture(captured.run, tmp_path / "other", masks="none")
    with pytest.raises(UserError, match="until must be page, got masks"):
        task.capture(captured.run, tmp_path / "other", until="masks")
    assert not (tmp_path / "other").exists()


@pytest.fixture
def steps(monkeypatch, tmp_path) -> list[tuple]:
    """Stand-ins for all steps: they write what the next looks at, and note what they are told."""
    noted = []

    def poses(photographs, out, masks=None, config=None):
        noted.append(("poses", photographs, masks))
        (out / "sparse/0").mkdir(parents=True)
        for name in ("cameras.bin", "images.bin"):
            (out / "sparse/0" / name).write_bytes(bytes(8))
        (out / "poses.json").write_text("{}")
        if masks:
            shutil.copytree(masks, out / "masks")
        return out

    def cutout(data, out, source, **options):
        noted.append(("cutout", data, source, *[o for o in options.values() if o not in USUAL]))
        out.mkdir()
        return out

    def train(config, resume, on_progress):
        noted.append(("train", config.data, resume))
        config.out.mkdir(exist_ok=True)
        text = json.dumps({"data": str(config.data), "downscale": 1, "allow_outside": False})
        (config.out / "config.json").write_text(text)
        for name in ("scene.safetensors", "trust.txt"):
            (config.out / name).write_text("all is sure")
        return config.out

    def evaluate(run, save, json):
        save.mkdir(parents=True)
        Image.new("RGB", (8, 8)).save(save / "contact_sheet.png")
        json.write_text('{"nvs_psnr": 31.25}')

    def write_page(run, path, title, notes, measures):
        path.write_text(f"{title}: {notes} {measures}")

    monkeypatch.setattr("univoxel.capture.poses.poses", poses)
    monkeypatch.setattr("univoxel.capture.cutout.cutout", cutout)
    monkeypatch.setattr("univoxel.cli.trainer.train", train)
    monkeypatch.setattr(task, "evaluate", evaluate)
    monkeypatch.setattr(task, "_check_trained", lambda wanted, done: None)
    monkeypatch.setattr(task, "export", lambda run, mesh: mesh.write_bytes(b"glTF"))
    monkeypatch.setattr(task, "relight_to_files", lambda *_, **__: None)
    monkeypatch.setattr("univoxel.capture.masks.mask_network", no_network)
    monkeypatch.setattr("univoxel.output.page.write_page", write_page)
    return noted


no_network = Mock(side_effect=MissingExtra("making masks with a network needs rembg"))


def red_is_the_object(*_):
    return lambda photograph: (photograph[..., 0] > 128).float()


@pytest.fixture
def pictures(tmp_path) -> Path:
    folder = tmp_path / "pictures of mine"
    folder.mkdir()
    for v in range(3):
        picture = np.zeros((12, 16, 3), np.uint8)
        picture[3:9, v : v + 4, 0] = 255
        Image.fromarray(picture).save(folder / f"{v}.png")
    return folder


@pytest.mark.parametrize("there", [False, True])
def test_masks_come_from_a_network_or_else_from_depth(
    steps, pictures, tmp_path, monkeypatch, caplog, there
):
    monkeypatch.setattr("univoxel.data.load_photos", without_masks)
    if there:
        monkeypatch.setattr("univoxel.capture.masks.mask_network", red_is_the_object)
    with caplog.at_level("INFO"):
        task.capture(pictures, tmp_path / "mug")
    if not there:
        with pytest.raises(MissingExtra, match="needs rembg"):  # one that was named
            task.capture(pictures, tmp_path / "other", network="silueta")
    assert steps[1] == ("cutout", tmp_path / "mug/scene", "rembg" if there else "none")
    assert ("masks are made from depth maps" in caplog.text) != there


def test_masks_of_ones_own_go_on(steps, pictures, tmp_path):
    out = tmp_path / "mug"
    out.mkdir()
    (out / ".steps.json.123.tmp").touch()  # of a writer that was killed
    task.capture(pictures, out, masks=pictures)
    assert not list(out.rglob("*.tmp"))
    assert steps == [
        ("poses", pictures, None),
        ("cutout", out / "scene", pictures),
        ("train", (out / "cut").absolute(), False),
    ]
    page = (out / "index.html").read_text("utf-8")
    assert "Made from 0.png and 2 others" in page
    assert "31.25" in page


without_masks = Mock(side_effect=WithoutMasks("none"))


def test_another_network_or_box_makes_other_masks(steps, pictures, tmp_path, monkeypatch):
    out, named = tmp_path / "mug", []
    monkeypatch.setattr(
        "univoxel.capture.masks.mask_network",
        lambda name: named.append(name) or red_is_the_object(),
    )
    task.find_data(pictures, out, masks="rembg", network="u2net")
    assert steps[1:] == [("cutout", out / "scene", "rembg", "u2net")]
    assert named == ["u2net"]
    task.find_data(pictures, out, masks="rembg", network="u2net")  # goes on
    with pytest.raises(ExistingFile, match=r"with masks=rembg, network=u2net: .*this folder and"):
        task.find_data(pictures, out, masks="rembg")
    other = tmp_path / "other"
    task.find_data(pictures, other, masks="rembg")
    assert json.loads((other / "steps.json").read_text())["masks"] == "rembg"  # as in 0.2
    with pytest.raises(ExistingFile, match="was made with masks=rembg: "):
        task.find_data(pictures, other, masks="rembg", network="u2net")
    boxed, box = tmp_path / "boxed", (0, 0, 0, 1, 1, 0.5)
    task.find_data(pictures, boxed, masks="none", box=box, keep_table=True)
    assert steps[-1] == ("cutout", boxed / "scene", "none", box, True)
    task.find_data(pictures, boxed, masks="none", box=list(box), keep_table=True)  # goes on
    said = r"with masks=none, box=0.0 0.0 0.0 1.0 1.0 0.5, keep_table=True: to make the masks again"
    with pytest.raises(ExistingFile, match=said):
        task.find_data(pictures, boxed, masks="none", box=box)
    with pytest.raises(UserError, match="already has masks, so a box would have no effect"):
        task.find_data(task.SCENE, tmp_path / "scene", box=box)


def test_a_scene_with_masks_is_trained_on_as_it_lies(steps, tmp_path, monkeypatch):
    scene = task.SCENE
    for _ in range(2):  # and are not read again to find out
        task.capture(scene, tmp_path / "mug")
        monkeypatch.setattr("univoxel.data.load_photos", None)
    assert steps == [("train", scene.absolute(), False)]
    kept = [p.name for p in (tmp_path / "mug").iterdir()]
    assert "scene" not in kept
    assert "cut" not in kept


def test_the_first_steps_alone(steps, pictures, tmp_path):
    out = tmp_path / "mug"
    assert task.find_data(pictures, out, until="cameras") == out / "scene"
    assert task.find_data(pictures, out, masks="none") == out / "cut"
    assert [name for name, *_ in steps] == ["poses", "cutout"]
    assert task.capture(pictures, out, masks="none").page.exists()  # goes on with them
    assert [name for name, *_ in steps] == ["poses", "cutout", "train"]
    with pytest.raises(UserError, match="is a trained run, so until must be page"):
        task.find_data(out / "run", tmp_path / "other")


def test_a_capture_of_version_0_2_is_gone_on_with(steps, pictures, tmp_path):
    out = tmp_path / "mug"
    task.find_data(pictures, out, masks="none")
    noted = json.loads((out / "steps.json").read_text())
    (out / "steps.json").unlink()
    (out / "capture.json").write_text(json.dumps({"kind": "photographs", **noted}))
    (pictures / "3.png").touch()
    with pytest.raises(ExistingFile, match=r"contains a capture of 0.png .*3.png is new"):
        task.capture(pictures, out, masks="none")
    (pictures / "3.png").unlink()
    with pytest.raises(ExistingFile, match="was made with masks=none"):
        task.capture(pictures, out)
    task.capture(pictures, out, masks="none")
    assert [name for name, *_ in steps] == ["poses", "cutout", "train"]


STATIC = "the background is static in 9 of 10 pairs of photographs"
still = Mock(side_effect=StillBackground(STATIC))


def test_a_turntable_gets_masks_first(steps, pictures, tmp_path, monkeypatch, caplog):
    out, own, found = tmp_path / "mug", tmp_path / "own", structure_from_motion.poses

    def poses(photographs, scene, masks=None, config=None):
        return (found if masks else still)(photographs, scene, masks)

    monkeypatch.setattr("univoxel.capture.poses.poses", poses)
    task.capture(pictures, own, masks=pictures)
    assert steps[:2] == [
        ("poses", pictures, pictures),
        ("cutout", own / "scene", own / "scene/masks"),
    ]
    steps.clear()
    with pytest.raises(MissingExtra, match="needs rembg"):
        task.capture(pictures, tmp_path / "none")
    with pytest.raises(UserError, match="masks are needed to find cameras: expected masks=rembg"):
        task.capture(pictures, tmp_path / "none", masks="none")
    monkeypatch.setattr("univoxel.capture.masks.mask_network", red_is_the_object)
    with caplog.at_level(logging.INFO, "univoxel"):
        task.capture(pictures, out)
    assert "9 of 10 pairs of photographs, as on a turntable, so masks are made" in caplog.text
    assert steps == [
        ("poses", pictures, out / "masks"),
        ("cutout", out / "scene", out / "scene" / "masks"),
        ("train", (out / "cut").absolute(), False),
    ]
    with pytest.raises(ExistingFile, match="found with masks from network=u2netp: pass"):
        task.capture(pictures, out, network="u2net")
    assert "s per photograph, about 10 s for all 3" in caplog.text
    for v in range(3):
        mask = np.asarray(Image.open(out / "masks" / f"{v}.png"))
        assert (mask == np.asarray(Image.open(pictures / f"{v}.png"))[..., 0]).all()


def test_a_turntable_goes_on_with_the_masks_that_are_there(steps, pictures, tmp_path, monkeypatch):
    """Killed among the masks: the background is not looked at again."""
    out, made = tmp_path / "mug", []
    monkeypatch.setattr("univoxel.capture.poses.poses", still)

    def killed(_):
        def mask(photograph):
            made.append(photograph)
            if len(made) == 3:
                raise KeyboardInterrupt
            return red_is_the_object()(photograph)

        return mask

    monkeypatch.setattr("univoxel.capture.masks.mask_network", killed)
    with pytest.raises(KeyboardInterrupt):
        task.capture(pictures, out)
    assert not (out / "masks").exists()
    told = []
    monkeypatch.setattr(
        "univoxel.capture.poses.poses",
        lambda p, scene, masks=None, config=None: told.append(masks) or scene,
    )
    task.capture(pictures, out)
    assert told == [out / "masks"]
    assert len(made) == 4  # two of three are kept


def test_what_cannot_be_begun_leaves_nothing(steps, pictures, tmp_path, monkeypatch, caplog):
    out = tmp_path / "mug"
    cases: list[tuple[Path, dict[str, Any], type[Exception], str]] = [
        (tmp_path / "none", {}, DataError, "expected a folder of photographs or a video, got not"),
        (pictures / "0.png", {}, DataError, "got another kind of file"),
        (pictures, {"masks": "nothing here"}, DataError, "masks: expected rembg, none or a folder"),
        (pictures, {"masks": "rembg"}, MissingExtra, "needs rembg"),
        (pictures, {"network": "u2"}, UserError, "network: expected one of u2netp, .*, got u2"),
        (pictures, {"network": "u2net", "masks": "none"}, UserError, "u2net applies only to masks"),
        (pictures, {"preset": "quick"}, UserError, "preset must be one of draft, fast, full, best"),
        (pictures, {"minutes": -1.0}, UserError, "minutes must be above 0"),
        (pictures, {"changes": ["colour=red"]}, UserError, "no field 'colour'"),
    ]
    for photographs, options, error, message in cases:
        with pytest.raises(error, match=message):
            task.capture(photographs, out, **options)
        assert not out.exists()
    with monkeypatch.context() as patch:
        patch.setattr("univoxel.capture.sfm.require_pycolmap", no_network)
        with pytest.raises(MissingExtra):
            task.capture(pictures, out)
    assert not out.exists()
    with monkeypatch.context() as patch, caplog.at_level("INFO", "univoxel"):
        patch.setattr(task, "_find_cameras", Mock(side_effect=DataError("no cameras")))
        with pytest.raises(DataError, match="no cameras"):
            task.capture(pictures, tmp_path / "later", masks=pictures, preset="draft")
    said = r"training takes about \d+ (s|min) on this machine, after cameras are found"
    assert re.search(said, caplog.text)
    out.touch()
    with pytest.raises(ExistingFile, match="is a file"):
        task.capture(pictures, out)
    with pytest.raises(ExistingFile, match=r"contains other files \(0.png\): choose another"):
        task.capture(pictures, pictures)
