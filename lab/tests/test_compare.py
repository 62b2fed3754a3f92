"""The table of the lights from made-up outcomes, and one real row."""

import builtins
import json
import shutil

import pytest
from tiny import OPTIONS

from lab import compare as module
from lab.record import Outcome
from univoxel.cli import main


def outcome(scene, light, psnr, error=None, **measures):
    measures = {"nvs_psnr": psnr, "map_ball_psnr": None, "train_seconds": 60.4, **measures}
    return Outcome(scene, light, {}, {} if error else measures, error=error)


ROWS = [
    outcome("cup", "sg", 30.0, roughness_mse=0.02),
    outcome("cup", "sh", 28.126, roughness_mse=0.004),
    outcome("shoe", "sg", 34.0),
    outcome("shoe", "sh", 0.0, "ValueError: a | b"),
]


def test_the_best_of_a_column_is_bold():
    cup, shoe, mean = module.markdown(ROWS).split("## ")[1:]
    assert cup.startswith("cup\n")
    sg, sh = cup.strip().splitlines()[-2:]
    assert sg.startswith("| sg | **30.00** | - |")
    assert sh.startswith("| sh | 28.13 | - |")
    assert "**0.0040**" in sh  # less is better
    assert "**60**" in sg
    assert shoe.strip().endswith("| sh | failed: ValueError: a / b |")
    assert "| sg | **32.00** |" in mean
    assert mean.strip().splitlines()[-1].startswith("| sh | failed")
    assert len({line.count("|") for line in (sg, sh)}) == 1


def test_one_scene_has_no_mean():
    assert module.markdown(ROWS[:2]).count("## ") == 1


@pytest.fixture
def passed(monkeypatch):
    """What reaches the runner, in place of the trainings."""
    noted = []

    def run(scenes, settings, out, samples, at_once, scheduler):
        noted.append((scenes, settings, out, samples))
        out.mkdir(exist_ok=True)
        return [
            outcome("cup", s.name, 30.0, "it broke" if "sh" in s.name else None) for s in settings
        ]

    monkeypatch.setattr(module.runner, "run", run)
    return noted


def test_settings_follow_from_the_arguments(passed, tmp_path):
    lights = ["sg", "sg:lobes=12,hidden=32"]
    out = module.compare([tmp_path], tmp_path / "out", "draft", lights, 2.0, ["seed=1"], 4)
    assert out == tmp_path / "out" / "compare.md"
    ((_, settings, _, samples),) = passed
    assert samples == 4
    assert [s.name for s in settings] == ["sg", "sg-lobes=12-hidden=32"]
    light = settings[1].config(tmp_path, tmp_path).scene.light
    assert (light.lobes, light.hidden) == (12, 32)
    assert {(s.preset, s.light, s.minutes, s.changes[0]) for s in settings} == {
        ("draft", "sg", 2.0, "seed=1")
    }
    record = json.loads((tmp_path / "out" / "compare.json").read_text())
    assert [row["setting"] for row in record["rows"]] == [s.name for s in settings]
    assert record["machine"]["threads"] >= 1


def test_failures_are_told_after_all_is_written(passed, tmp_path):
    with pytest.raises(RuntimeError, match=r"1 of 2 training runs failed; .*cup/sh: it broke"):
        module.compare([tmp_path], tmp_path / "out", light=["sg", "sh"])
    names = {"compare.md", "compare.json", "compare.png", "compare.svg"}
    assert {p.name for p in (tmp_path / "out").iterdir()} == names


def test_an_unknown_light(passed, tmp_path):
    with pytest.raises(ValueError, match=r"light must be one of hybrid, sg, .*, got 'moon'"):
        module.compare([tmp_path], tmp_path, light=["moon"])
    assert not passed


def test_without_matplotlib_nothing_is_trained(passed, tmp_path, monkeypatch, capsys):
    real = builtins.__import__

    def without(name, *rest, **options):
        if name.startswith("matplotlib"):
            raise ImportError(name)
        return real(name, *rest, **options)

    monkeypatch.setattr(builtins, "__import__", without)
    assert main(["compare", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert (
        said == "univoxel lab compare: the images need matplotlib: pip install 'univoxel[chart]'\n"
    )
    assert not passed


def test_the_command_on_a_small_scene(tiny, tmp_path, capsys):
    data = shutil.copytree(tiny / "data", tmp_path / "ball")
    out = tmp_path / "out"
    arguments = ["--preset", "draft", "--light", "hybrid:lobes=1", "--samples", "1"]
    assert main(["compare", str(data), "--out", str(out), *arguments, *OPTIONS[1:]]) == 0
    assert capsys.readouterr().out.strip().endswith("compare.md")
    (row,) = json.loads((out / "compare.json").read_text())["rows"]
    assert row["measures"]["nvs_psnr"] > 0
    assert (out / "ball" / "hybrid-lobes=1" / "envmap.exr").is_file()
