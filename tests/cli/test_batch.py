"""Many scenes, with real trainings of a moment: done once, killed, broken, shared by two."""

import csv
import dataclasses
import json
import os
import re
import shutil
import signal
import sys
import threading
from pathlib import Path

import pytest
from analytic import write_scene
from clusters import wait_for
from tiny import OF_LOBES as TINY

from univoxel.batch.scenes import (
    PER_PIXEL,
    SceneResult,
    bytes_of,
    named,
    share,
    write_results,
    write_sheet,
)
from univoxel.cli import batch as task
from univoxel.cli import main
from univoxel.cli.batch import BatchOptions, job_of
from univoxel.config import save_config
from univoxel.core.machine import Memory
from univoxel.errors import MissingExtra, ProcessFailed, UserError
from univoxel.scene import FILE, load_checkpoint
from univoxel.training.pixels import PER_PIXEL as FURTHER

# Its steps take a moment; draft's minute would cut them on a busy machine
USUAL = BatchOptions(scenes=(), out=Path("night"))
DRAFT = {"steps": ("train",), "preset": "draft", "light": "sg", "minutes": 30.0}
OPTIONS = dataclasses.replace(USUAL, **DRAFT, changes=TINY, samples=1, jobs=2)
# The first stage is saved at once; the second takes long enough to be killed in
SLOW = dataclasses.replace(OPTIONS, changes=(*TINY, "stages.1.iterations=600"))


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    root = tmp_path_factory.mktemp("scenes")
    return [write_scene(root / name, views=6, size=16) for name in ("ball", "cup")]


def run_batch(scenes, out, options=OPTIONS, **how):
    threads = how.pop("threads", 1)
    return task.batch(dataclasses.replace(options, scenes=scenes, out=out, **how), threads)


def said(out: Path, name: str) -> str:
    path = out / "logs" / f"{name}.txt"
    return path.read_text() if path.exists() else ""


def trainings(out: Path, name: str) -> int:
    """Processes that trained a scene."""
    return said(out, name).count("univoxel.cli train")


def training_process(out: Path, name: str) -> int:
    """The process that trains a scene; 0: there is none."""
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = path.read_bytes().split(b"\0")
        except OSError:
            continue
        if b"train" in words and str(out / name / "run").encode() in words:
            return int(path.parent.name)
    return 0


def parent(process: int) -> int:
    return int(Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[1])


def in_mid_training(out: Path, name: str) -> bool:
    """Whether its first stage is saved, and not all of it is done."""
    folder = out / name / "run"
    return (folder / FILE).exists() and not (folder / "trust.txt").exists()


def went_on(out: Path, name: str) -> bool:
    """Whether a later process began with what an earlier one had saved."""
    return said(out, name).count("nothing has been saved") == 1 < trainings(out, name)


def whole(out: Path, name: str) -> bool:
    return load_checkpoint(out / name / "run")[1]["made"] == [1.0, 1.0]


@pytest.fixture(scope="module")
def night(scenes, tmp_path_factory):
    """Two scenes through all of the usual steps, by the command line."""
    out = tmp_path_factory.mktemp("out") / "night"
    sets = [f"--set={change}" for change in TINY]
    options = ["--preset", "draft", "--light", "sg", "--minutes", "30", "--samples", "1", *sets]
    assert main(["batch", *map(str, scenes), "--out", str(out), "--jobs", "2", *options]) == 0
    return out, options


def test_each_scene_has_all_of_its_results(night):
    out, _ = night
    for name in ("ball", "cup"):
        assert whole(out, name)
        assert (out / name / f"{name}.glb").read_bytes()[:4] == b"glTF"
        assert json.loads((out / name / "measures.json").read_text())["nvs_psnr"] > 5
        page = (out / name / "index.html").read_text()
        assert f"<title>{name}" in page
        assert not (out / name / "run" / "index.html").exists()  # not twice
    record = json.loads((out / "batch.json").read_text())
    assert record["options"]["preset"] == "draft"
    ball, cup = record["scenes"]
    assert (ball["name"], ball["state"], ball["errors"]) == ("ball", "done", {})
    words = {"good", "usable", "retake", "unfinished"}
    assert {ball["verdict"], cup["verdict"]} <= words
    assert set(ball["seconds"]) == {"train", "eval", "export", "page"}
    assert 0 <= ball["expected"]["albedo_error"] <= 1
    rows = list(csv.DictReader((out / "batch.csv").read_text().splitlines()))
    assert [row["name"] for row in rows] == ["ball", "cup"]
    assert [row["verdict"] for row in rows] == [ball["verdict"], cup["verdict"]]
    assert float(rows[1]["nvs_psnr"]) == pytest.approx(cup["measures"]["nvs_psnr"], rel=1e-5)
    page = (out / "index.html").read_text()
    assert page.count('<img alt="" src="data:image/jpeg;base64,') == 2
    assert page.rstrip().endswith("</html>")
    assert "<p>2 done</p>" in page
    links = re.findall(r'href="([^"]+)"', page)
    assert sorted(links) == ["ball/index.html", "cup/index.html", "logs/ball.txt", "logs/cup.txt"]
    assert all((out / link).exists() for link in links)
    assert not re.search(r'(src|href)="https?:', page)


def test_what_is_done_is_not_done_again(night, scenes, capsys):
    out, options = night
    before = {path: path.stat().st_mtime_ns for path in (out / "ball").rglob("*")}
    arguments = ["batch", *map(str, scenes), "--out", str(out), *options]
    assert main([*arguments, "--json", "-"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out) == json.loads((out / "batch.json").read_text())
    assert {path: path.stat().st_mtime_ns for path in (out / "ball").rglob("*")} == before
    assert trainings(out, "ball") == 1
    assert main(["batch", str(scenes[0]), "--out", str(out), *options, "--set=seed=4"]) == 2
    assert re.search(r"ball\.json has other values of changes .*--out", capsys.readouterr().err)


def test_a_scene_that_fails_takes_no_other_with_it(scenes, tmp_path, monkeypatch, capsys):
    """One cannot be read, and the disk is full for one; later it has room."""
    broken, full = tmp_path / "broken", tmp_path / "full"
    broken.mkdir()
    shutil.copytree(scenes[0], full)
    out = tmp_path / "night"
    patch = tmp_path / "patch"
    patch.mkdir()
    (patch / "sitecustomize.py").write_text(
        "import errno, os\n"
        "replace = os.replace\n"
        "def fails(source, target):\n"
        f"    if str(target).startswith({str(out / 'full')!r}):\n"
        "        raise OSError(errno.ENOSPC, 'No space left on device')\n"
        "    replace(source, target)\n"
        "os.replace = fails\n"
    )
    path = os.environ.get("PYTHONPATH", "")
    monkeypatch.setenv("PYTHONPATH", f"{patch}:{path}")
    options = ["--steps", "train", "--preset", "draft", "--light", "sg", "--minutes", "30"]
    options += ["--samples", "1", *(f"--set={change}" for change in TINY)]
    given = [*map(str, (broken, full, scenes[1])), "--out", str(out), "--jobs", "2"]
    assert main(["batch", *given, *options]) == 2
    captured = capsys.readouterr()
    assert captured.err.splitlines()[-1].startswith(
        "univoxel batch: 2 of 3 scenes failed (broken, full): run the same"
    )
    lines = captured.out.splitlines()
    assert [line for line in lines if line.startswith("broken: failed in train: univoxel train: ")]
    (line,) = (line for line in lines if line.startswith("full: failed in train: "))
    assert "No space left" in line
    assert whole(out, "cup")
    assert not (out / "full" / "run" / FILE).exists()  # whole or absent
    page = (out / "index.html").read_text()
    assert "<p>2 failed, 1 done</p>" in page
    assert page.index("broken") < page.index("cup")

    monkeypatch.setenv("PYTHONPATH", path)
    assert main(["batch", *given, *options]) == 2
    assert "1 of 3 scenes failed (broken)" in capsys.readouterr().err
    assert whole(out, "full")
    assert trainings(out, "cup") == 1


def test_a_training_that_is_killed_goes_on(scenes, tmp_path):
    def kill() -> None:
        wait_for(lambda: in_mid_training(tmp_path, "ball"), 240)
        os.kill(training_process(tmp_path, "ball"), signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    (result,) = run_batch(scenes[:1], tmp_path, SLOW)
    killer.join()
    assert result.state == "done"
    assert went_on(tmp_path, "ball")
    assert whole(tmp_path, "ball")
    assert trainings(tmp_path, "ball") == 2


def test_masks_that_photographs_bring_are_taken(scenes, tmp_path):
    """Then nothing is cut out; what made no file is looked at again only until it was trained."""
    options = dataclasses.replace(OPTIONS, steps=("masks", "train"))
    assert run_batch(scenes[:1], tmp_path, options)[0].state == "done"
    assert not (tmp_path / "ball" / "cut").exists()
    assert whole(tmp_path, "ball")
    words = said(tmp_path, "ball")
    assert run_batch(scenes[:1], tmp_path, options)[0].state == "done"
    assert said(tmp_path, "ball") == words


def test_steps_of_raw_photographs(tmp_path):
    options = dataclasses.replace(OPTIONS, steps=("page", "train", "poses", "masks"), masks="none")
    options = dataclasses.replace(options, out=tmp_path / "night")
    job = job_of("mug", tmp_path / "mug", options, 1)
    assert [step.name for step in job.steps] == ["poses", "masks", "train", "page"]
    poses, masks, train, page = job.steps
    folder = tmp_path / "night" / "mug"
    assert poses.words()[2:] == [
        *("capture", str(tmp_path / "mug"), "--out", str(folder), "--masks", "none"),
        *("--until", "cameras"),
    ]
    assert masks.words()[-2:] == ["--until", "masks"]
    assert train.words()[3] == str(tmp_path / "mug")
    for name in ("scene", "cut"):  # each takes the place of those before
        (folder / name).mkdir(parents=True)
        assert train.words()[3] == str(folder / name)
    assert masks.done()
    assert not poses.done()
    (folder / "scene" / "poses.json").touch()
    assert poses.done()
    assert (train.needed, page.needed) == (True, False)


def test_what_a_training_of_a_batch_is_asked_for(tmp_path):
    def options(threads, **changes) -> str:
        asked = dataclasses.replace(USUAL, out=tmp_path, **changes)
        train = job_of("mug", tmp_path, asked, threads).steps[0]
        return " ".join(train.words()[5:])

    # A preset makes all its steps, on any number of threads
    assert options(1).endswith("--preset auto --light hybrid")
    assert options(2, preset="draft").endswith("--preset draft --light hybrid")
    assert options(1, minutes=3.0).endswith("--preset auto --light hybrid --minutes 3")
    config = dataclasses.replace(USUAL.training(), out=tmp_path)
    save_config(config)
    alike = options(1, config=tmp_path / "config.json", changes=("seed=2",))
    assert f"--config {tmp_path / 'config.json'} --set=seed=2" in alike
    asked = dataclasses.replace(USUAL, config=tmp_path / "config.json", minutes=2.0)
    assert asked.training() == dataclasses.replace(config, out=Path(), minutes=2.0)


def test_a_machine_is_shared(scenes, tmp_path):
    known = scenes * 4
    config = USUAL.training()
    plenty = Memory(10**13, 10**13)
    assert share(known, config, 16.0, plenty) == (8, 2)
    assert share(known, config, 4.0, plenty) == (4, 1)
    assert share(known, config, 4.0, None, threads=2) == (2, 2)
    assert share(known, config, 4.0, plenty, jobs=3) == (3, 1)
    assert share(known, config, 0.5, plenty) == (1, 1)
    most = bytes_of(scenes[0], config)
    assert share(known, config, 16.0, Memory(10**13, int(3.5 * most))) == (3, 5)
    assert share(known, config, 16.0, Memory(most // 2, None)) == (1, 16)
    # More pictures need more memory: the photograph, and what training makes of it
    many, each = write_scene(tmp_path / "many", views=12, size=64), PER_PIXEL + FURTHER
    assert bytes_of(many, config) - most == each * (14 * 64**2 - 8 * 16**2)
    (many / "train" / "r_0.png").write_bytes(b"")
    assert bytes_of(many, config) - most == each * (13 * 64**2 - 8 * 16**2)


def test_mistakes_are_found_before_anything_is_begun(scenes, tmp_path, monkeypatch):
    def refused(error, match, given=tuple(scenes), **options):
        with pytest.raises(error, match=match):
            run_batch(given, tmp_path / "out", **options)
        assert not (tmp_path / "out").exists()

    (tmp_path / "mug.mp4").touch()
    assert named([tmp_path / "mug.mp4"]) == {"mug": tmp_path / "mug.mp4"}  # a video is a scene
    refused(UserError, "expected at least one scene", [])
    none = "nothing: expected a scene, but the folder does not exist"
    refused(UserError, none, [tmp_path / "nothing"])
    other = tmp_path / "b" / "ball"
    other.mkdir(parents=True)
    refused(UserError, "folders with different names, got .*ball and .*ball", [scenes[0], other])
    (tmp_path / "logs").mkdir()
    refused(UserError, "the name 'logs' is reserved: rename the folder", [tmp_path / "logs"])
    for name in ("jobs", "threads", "tries"):
        refused(UserError, f"{name} must be at least 1, got 0", **{name: 0})
    for field, value, match in (
        ("samples", 0, "samples must be at least 1, got 0"),
        ("steps", (), "steps must be among poses, masks, .*, got none"),
        ("steps", ("fly",), "steps must be among .*, got fly"),
        ("changes", ("seed=x",), "changes=seed=x: expected a value such as 0 .int"),
        (
            "config",
            tmp_path / "none.json",
            "preset=.* cannot be combined with config: .*none.json sets it too",
        ),
    ):
        refused(UserError, match, options=dataclasses.replace(OPTIONS, **{field: value}))
    refused(UserError, "expected jobs or scheduler, but not both", scheduler="tcp://x:1")
    monkeypatch.setitem(sys.modules, "distributed", None)
    refused(MissingExtra, r"univoxel\[cluster\]")


def test_what_is_not_known_is_a_dash_or_empty(tmp_path):
    results = [
        SceneResult("a<b", "/a", "a<b", "failed", {"train": "x < y"}, {}),
        SceneResult("c", "/c", "c", "done", {}, {"train": 61.5}, "good", {"nvs_psnr": 30.04}),
    ]
    page = write_sheet(results, tmp_path).read_text()
    assert "a&lt;b" in page
    assert "train: x &lt; y" in page
    assert "<td>30.0" in page
    assert "<td>62 s" in page
    assert "albedo, dB" not in page
    write_results(results, {}, tmp_path)
    rows = list(csv.DictReader((tmp_path / "batch.csv").read_text().splitlines()))
    assert [row["verdict"] for row in rows] == ["", "good"]
    assert (rows[0]["nvs_psnr"], rows[0]["train_s"], rows[0]["error"]) == ("", "", "train: x < y")
    with pytest.raises(ProcessFailed, match=r"1 of 2 scenes failed \(a<b\)"):
        task.check(results)
    assert task.check(results[1:]) is None
