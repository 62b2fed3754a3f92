"""The chart of quality against time, from made-up outcomes."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from lab import chart as module
from lab.plots import pareto
from lab.record import Outcome


def test_the_front_is_what_no_other_beats():
    points = [(60, 30.0), (240, 36.0), (300, 35.0), (720, 36.0), (900, 38.0), (60, 29.0)]
    assert pareto(points, more=True) == [0, 1, 4]
    assert pareto([(t, -v) for t, v in points], more=False) == [0, 1, 4]
    assert pareto([], more=True) == []


@pytest.mark.parametrize("light", ["hybrid", "sg", "mlp"])
def test_every_setting_is_a_configuration_of_its_own(light):
    found = module.settings("fast", light)
    assert list(found)[:3] == ["draft", "fast", "full"]
    configs = [repr(s.config(Path(), Path())) for s in found.values()]
    assert len(set(configs)) == len(configs)
    assert ("lobes-x0.5" in found) == (light != "mlp")
    assert f"light-{light}" not in found
    assert set(module.QUICK) - {f"light-{light}"} <= set(found)


def test_a_knob_turns_what_it_says():
    base, double = (
        module.settings("fast", "hybrid")[name].config(Path(), Path())
        for name in ("fast", "voxels-x2")
    )
    finest = max(getattr(s, "voxels", 0) for s in base.stages)
    for before, after in zip(base.stages, double.stages, strict=True):
        if getattr(before, "voxels", None) == finest:
            assert after.voxels == 2 * finest
        else:
            assert after == before
    half = module.settings("fast", "hybrid", ("seed=4",))["rays-x0.5"].config(Path(), Path())
    assert half.seed == 4
    assert [s.rays for s in half.stages] == [s.rays // 2 for s in base.stages]
    assert [s.iterations for s in half.stages] == [s.iterations for s in base.stages]


def outcome(scene, name, seconds, psnr, mse=None):
    measures = {"nvs_psnr": psnr, "roughness_mse": mse, "train_seconds": seconds}
    log = [
        {"seconds": t * seconds, "stage": 0, "held_out_psnr": q}
        for t, q in ((0.2, 20.0), (0.5, None), (0.9, 28.0))
    ]
    return Outcome(scene, name, {}, measures, log)


ROWS = [
    outcome("cup", "draft", 60, 30.0, 0.02),
    outcome("cup", "fast", 240, 29.0, 0.01),
    outcome("cup", "voxels-x2", 300, 31.0, 0.01),
    outcome("shoe", "draft", 60, 30.0),
    Outcome("shoe", "fast", {}, error="ValueError: no"),
]


def test_fronts_by_scene_and_measure():
    found = module.fronts(ROWS)
    assert found["cup"]["nvs_psnr"] == ["draft", "voxels-x2"]
    assert found["cup"]["roughness_mse"] == ["draft", "fast"]
    assert found["shoe"] == {m.key: [] for m in module.SHOWN} | {"nvs_psnr": ["draft"]}


@pytest.fixture
def passed(monkeypatch):
    """What reaches the runner, in place of the trainings."""
    noted = []

    def run(scenes, settings, out, samples, at_once, scheduler):
        noted.append([s.name for s in settings])
        out.mkdir(exist_ok=True)
        return [outcome("cup", s.name, 60, 30.0) for s in settings]

    monkeypatch.setattr(module.runner, "run", run)
    return noted


def test_which_settings_are_trained(passed, tmp_path):
    out = tmp_path / "out"
    assert module.chart([tmp_path], out, quick=True) == out / "chart.png"
    module.chart([tmp_path], out, "draft", quick=True)
    module.chart([tmp_path], out, only=["fast", "lobes-x2"])
    assert passed == [
        ["draft", "fast", *module.QUICK],
        ["draft", *module.QUICK],
        ["fast", "lobes-x2"],
    ]
    assert {p.name for p in out.iterdir()} == {"chart.json", "chart.png", "chart.svg"}
    record = json.loads((out / "chart.json").read_text())
    assert [p["setting"] for p in record["points"]] == ["fast", "lobes-x2"]
    assert record["fronts"]["cup"]["nvs_psnr"] == ["fast"]
    assert {p["minutes"] for p in record["published"]} >= {18, 14, None}
    with pytest.raises(ValueError, match=r"only must be among draft, fast, full, .*, got speed"):
        module.chart([tmp_path], out, only=["fast", "speed"])


def test_of_several_seeds_the_median_is_shown(monkeypatch, tmp_path):
    """One run in three that came out badly changes nothing; one that failed is told."""
    noted = []

    def run(scenes, settings, out, samples, at_once, scheduler):
        noted.extend((s.name, s.config(tmp_path, out).seed) for s in settings)
        out.mkdir(exist_ok=True)
        return [outcome("cup", s.name, 60, psnr) for s, psnr in zip(settings, PSNR, strict=True)]

    monkeypatch.setattr(module.runner, "run", run)
    module.chart([tmp_path], tmp_path / "out", only=["draft", "fast"], seeds=3)
    assert noted == [("draft", 0), ("fast", 0), ("fast-s1", 1), ("fast-s2", 2)]
    points = json.loads((tmp_path / "out" / "chart.json").read_text())["points"]
    assert [(p["setting"], p["measures"]["nvs_psnr"]) for p in points] == [
        ("draft", 28.0),
        ("fast", 31.0),
    ]
    assert [p["ranges"]["nvs_psnr"] for p in points] == [0.0, 22.0]
    failed = replace(outcome("cup", "fast-s1", 60, 31.0), error="ValueError: no")
    assert module.median_of([outcome("cup", "fast", 60, 30.0), failed]).error == "ValueError: no"
    with pytest.raises(ValueError, match="seeds must be at least 1, got 0"):
        module.chart([tmp_path], tmp_path / "out", seeds=0)


PSNR = (28.0, 10.0, 32.0, 31.0)  # of draft, three of fast
