"""Every mistake of a user ends, from the command line, in one line, exit code 2 and no debris."""

import json
import os
import re
import resource
import shutil
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from tiny import OPTIONS

from univoxel.cli import main
from univoxel.data.images import read_exr, read_image, write_exr
from univoxel.scene import FILE
from univoxel.training import progress


@pytest.fixture
def data(tiny_copy):
    return tiny_copy / "data"


@pytest.fixture
def run(tiny_copy):
    return tiny_copy / "run"


@pytest.fixture
def refused(capsys):
    """Run a command that must end in one line that matches, and in nothing else."""

    def check(message: str, *arguments: object) -> None:
        capsys.readouterr()
        assert main([str(a) for a in arguments]) == 2
        out, err = capsys.readouterr()
        assert err.count("\n") == 1, err
        assert re.search(message, err), err
        assert "Traceback" not in out + err

    return check


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (shutil.rmtree, r"data: expected a folder with a scene, got nothing there"),
        (
            lambda d: (d / "transforms_train.json").write_text('{"frames": [}'),
            r"transforms_train\.json: invalid JSON in line 1, column 13",
        ),
        (
            lambda d: [(d / "train" / f"r_{v}.png").unlink() for v in range(1, 5)],
            r"missing images: .*train/r_1, .*train/r_2, .*train/r_3, \.\.\. \(4 of 6\)",
        ),
    ],
)
def test_data_that_cannot_be_used(data, tmp_path, refused, change, message):
    """All that readers refuse is in tests/data."""
    change(data)
    refused(f"^univoxel train: .*{message}", "train", data, "--out", tmp_path / "new" / "run")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--minutes", "0"], "--minutes must be above 0, got 0"),
        (["--set=stages.0.share=1.5"], r"StageConfig: share must be in \(0, 1\], got 1.5"),
        (["--varying", "light", "--light", "envmap"], "--varying light needs --light hybrid"),
        (["--varying", "weather"], "'weather' for argument '--varying'"),
    ],
)
def test_settings_out_of_range(data, tmp_path, refused, options, message):
    refused(message, "train", data, "--out", tmp_path / "out", *options)
    assert not (tmp_path / "out").exists()


def test_a_number_where_a_path_is_wanted(run, tmp_path, refused):
    refused("univoxel train: 42: expected a folder", "train", 42, "--out", tmp_path / "out")
    refused("univoxel eval: 42: expected the folder of a run", "eval", 42)
    refused("univoxel eval: 42: expected a folder with a scene", "eval", run, "--data", 42)
    refused("univoxel relight: 42: expected an image", "relight", run, "--envmap", 42)
    refused(r"ends in .*\.ply.*, got 42", "export", run, "--mesh", 42)


def meta(change):
    def apply(path):
        with safe_open(path, "pt") as file:
            meta = json.loads(file.metadata()["univoxel"])
        change(meta)
        save_file(load_file(path), path, {"univoxel": json.dumps(meta)})

    return apply


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (meta(lambda m: m.update(format=99)), r"expected checkpoint format \d+, got 99"),
        (lambda p: save_file(load_file(p), p), r"expected checkpoint format \d+, got None"),
        (lambda p: p.write_bytes(p.read_bytes()[:-9]), r"scene\.safetensors: damaged or truncated"),
        (lambda p: p.write_bytes(b""), r"scene\.safetensors: damaged or truncated"),
        (Path.unlink, r"not a trained run .*run .*univoxel train"),
    ],
)
def test_checkpoints_that_cannot_be_used(run, data, tmp_path, refused, change, message):
    change(run / FILE)
    before = sorted(run.iterdir()), (run / "config.json").read_bytes()
    refused(message, "eval", run, "--save", tmp_path / "out")
    refused(message, "export", run, "--mesh", tmp_path / "out" / "a.ply")
    if (run / FILE).exists():  # else training begins
        refused(message, "train", data, "--out", run, "--resume")
    assert not (tmp_path / "out").exists()
    assert before == (sorted(run.iterdir()), (run / "config.json").read_bytes())


def test_a_run_that_was_killed_before_its_first_checkpoint(run, data, capsys):
    """It left a configuration and a log of work that is gone: with --resume it begins."""
    (run / FILE).unlink()
    (run / "log.jsonl").write_text("gone\n")
    assert main(["train", str(data), "--out", str(run), "--resume", *OPTIONS]) == 0
    assert f"{run}: nothing has been saved yet" in capsys.readouterr().out
    assert (run / FILE).is_file()
    assert "gone" not in ((run / "log.jsonl").read_text() if (run / "log.jsonl").exists() else "")


def edited_tensor(name, change):
    def apply(path):
        with safe_open(path, "pt") as file:
            meta = file.metadata()
        tensors = load_file(path)
        tensors[name] = change(tensors[name])
        save_file({k: v for k, v in tensors.items() if v is not None}, path, meta)

    return apply


WEIGHT = "material.net.0.weight"


def of_light(**values):
    return meta(lambda m: m["scene"]["light"].update(values))


def nan(tensor):
    tensor.view(-1)[0] = np.nan
    return tensor


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (meta(lambda m: m.update(inv_s="sharp")), "inv_s must be float, got 'sharp'"),
        (meta(lambda m: m.update(inv_s=10**400)), "inv_s must be float, got 1000"),
        (meta(lambda m: m.update(inv_s=np.nan)), "inv_s must be above 0, got nan"),
        (meta(lambda m: m.update(levels=7)), "do not match the header"),
        (meta(lambda m: m["levels"][2].append("fine")), "voxel_sizes must be tuple"),
        (meta(lambda m: m["levels"].__setitem__(3, 3)), "rows must be a power of two"),
        (meta(lambda m: m["levels"].__setitem__(3, 2**40)), "field.features has"),
        (meta(lambda m: m["grid"].update(origin=None)), "origin must be tuple"),
        (meta(lambda m: m["grid"].update(size=[10**5] * 3)), "size must be at least 2 along"),
        (meta(lambda m: m["grid"].update(size=[1200] * 3)), "field.sdf"),
        (meta(lambda m: m.update(scene=[])), "do not match the header"),
        (meta(lambda m: m["scene"].update(hidden=10**5)), "expected material.net.0.weight with"),
        (meta(lambda m: m["scene"].update(hidden=True)), "hidden must be int"),
        (meta(lambda m: m["scene"].update(more=1)), "SceneConfig: no field 'more'"),
        (meta(lambda m: m["scene"].pop("light")), "do not match the header"),
        (meta(lambda m: m["scene"].update(light=[])), "light must be a JSON object"),
        (meta(lambda m: m["scene"].update(light={"kind": "candle"})), "light must be one of"),
        (of_light(rank=1), "SGConfig: no field 'rank'"),
        (meta(lambda m: m["scene"].update(channels=0)), "channels must be at least 1"),
        (of_light(layers=10**5), r"layers must be in \[0, 32\]"),
        (of_light(directions_eval=10**9), r"directions_eval must be in \[1, 65536\]"),
        (meta(lambda m: m.update(state=[1])), "do not match the header"),
        (meta(lambda m: m["state"].update(stage="last")), "stage must be int"),
        (meta(lambda m: m["state"].update(progress=2)), r"progress must be in \[0, 1\]"),
        (meta(lambda m: m["state"].update(chosen=[{"what": 1}])), "what must be str"),
        (edited_tensor(WEIGHT, nan), "material.net.0.weight contains NaN or infinity"),
        (edited_tensor(WEIGHT, lambda t: None), "material.net.0.weight is missing"),
        (edited_tensor("field.feature_rows", lambda t: t - 10**6), "field.features"),
        (edited_tensor("field.feature_values", lambda t: t[:1]), "field.features"),
    ],
)
def test_checkpoints_that_contradict_themselves(run, refused, change, message):
    change(run / FILE)
    refused(rf"scene\.safetensors: .*{message}", "info", run)


@contextmanager
def full_disk(room: int):
    """Files stop growing at `room` bytes: a write is cut there, the next one fails."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize(
    ("room", "report", "message", "left"),
    [
        (100, 99.0, r"cannot write: .*config\.json", set()),
        (None, 0.0, r"cannot write: .*log\.jsonl", {"config.json", "log.jsonl"}),
        (None, 99.0, r"scene\.safetensors: cannot write the checkpoint", {"config.json"}),
    ],
)
def test_training_on_a_full_disk(
    tiny, data, tmp_path, refused, monkeypatch, room, report, message, left
):
    """Without a number there is room for the configuration, and a little more."""
    room = room or (tiny / "run" / "config.json").stat().st_size + 500
    monkeypatch.setattr(progress, "REPORT_SECONDS", report)
    out = tmp_path / "out"
    with full_disk(room):
        refused(message, "train", data, "--out", out, *OPTIONS, "--set=stages.0.iterations=40")
    assert {p.name for p in out.iterdir()} == left
    for path in out.iterdir():
        for line in path.read_text().splitlines() if path.suffix == ".jsonl" else []:
            json.loads(line)


def test_results_on_a_full_disk(run, tmp_path, refused):
    map = tmp_path / "map.exr"
    write_exr(map, {c: np.ones((4, 8), np.float32) for c in "RGB"})
    out = tmp_path / "out"
    with full_disk(100):
        refused(r"cannot write: .*r_0\.exr", "eval", run, "--save", out)
        refused(r"cannot write: .*a\.json", "eval", run, "--json", out / "a.json")
        refused(r"cannot write: .*a\.ply", "export", run, "--mesh", out / "a.ply")
        refused(r"cannot write: .*r_0\.", "relight", run, "--envmap", map, "--out", out)
    assert not list(out.iterdir())


def test_folders_that_cannot_be_made(data, run, tmp_path, refused, monkeypatch):
    (tmp_path / "file").touch()
    refused("Not a directory: .*file/out", "train", data, "--out", tmp_path / "file" / "out")
    refused("Not a directory: .*file/out", "eval", run, "--save", tmp_path / "file" / "out")

    def denied(path, *_):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(os, "mkdir", denied)  # permissions do not bind root
    refused("Permission denied: .*new", "train", data, "--out", tmp_path / "new")
    refused("Permission denied: .*new", "eval", run, "--json", tmp_path / "new" / "a.json")
    refused("Permission denied: .*new", "export", run, "--mesh", tmp_path / "new" / "a.ply")


def test_the_template_is_sound(run, tmp_path):
    """What the tests above break works when it is whole."""
    out = tmp_path / "out"
    arguments = ["--save", str(out), "--json", str(out / "a.json"), "--samples", "1"]
    assert main(["eval", str(run), *arguments]) == 0
    names = {"a.json", "contact_sheet.png", "r_0.exr", "r_1.exr", "trust.txt"}
    assert names == {p.name for p in out.iterdir()}
    assert {f"expected_error.{x}" for x in ("albedo", "roughness", "normal")} <= set(
        read_exr(out / "r_0.exr")
    )
    assert 0 <= json.loads((out / "a.json").read_text())["trust"]["albedo_error"] <= 1
    assert "Mean expected error of the surface" in (run / "trust.txt").read_text()
    assert read_image(run / "preview.png").shape == (16, 5 * 16, 3)
