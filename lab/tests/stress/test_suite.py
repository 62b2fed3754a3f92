"""The suite as a whole, over stand-ins for the renderer and the trainings; once for real."""

import dataclasses
import importlib.util
import json
import math
import re
from pathlib import Path

import pytest
from tiny import OPTIONS

from lab.record import Outcome
from lab.stress import axes, render, suite
from lab.stress.axes import AXES, BASE, INTACT
from lab.stress.scenes import Spec
from univoxel.cli import main
from univoxel.config import JointConfig
from univoxel.core.choices import LIGHTS


def test_every_axis_begins_with_its_reference_or_an_easier_level():
    for axis in AXES.values():
        reference = axis.levels[axis.reference]
        own = axis.name in ("concavity", "thin", "turntable", "fur")
        assert own or (reference.spec, reference.damage) == (BASE, INTACT)
        assert not reference.changes
        labels = [level.label for level in axis.levels]
        assert len(set(labels)) == len(labels) >= 3
        folder = re.compile(r"[\w.+-]+")
        assert all(folder.fullmatch(f"{axis.name}-{label}") for label in labels)
        values = [level.value for level in axis.levels]
        assert values in (sorted(values), sorted(values, reverse=True))


def test_quick_keeps_the_reference_and_the_hardest():
    for axis, full in zip(axes.chosen((), True), AXES.values(), strict=True):
        assert 2 <= len(axis.levels) <= 3
        assert axis.levels[axis.reference] == full.levels[full.reference]
        assert axis.levels[-1] == full.levels[-1]
    (views,) = axes.chosen(["views"], False)
    assert views == AXES["views"]
    with pytest.raises(ValueError, match=r"only must be of roughness, .*, bright, got fog"):
        axes.chosen(["views", "fog"], True)


@pytest.mark.parametrize("light", LIGHTS)
def test_trainings_are_by_steps(light):
    one_light = light.startswith("envmap") or light == "baked"
    axes = ["views"] if one_light else ["views", "light-varying"]
    for level in [AXES[axis].levels[1] for axis in axes]:
        one = suite.setting(light, 2, level)
        config = one.config(Path("photos"), Path("run"))
        assert config.minutes == suite.MINUTES
        assert config.seed == 2
        assert config.scene.varying == ("light" if level.changes else "none")
        assert one.name == f"{light}{'-light' if level.changes else ''}-s2"


def test_colors_tell_of_the_light_as_in_longer_presets():
    """They found suns until draft, whose trainings are made small here, left them only."""
    config = suite.setting("hybrid", 0, AXES["sun"].levels[1]).config(Path("photos"), Path("run"))
    (joint,) = (s for s in config.stages if isinstance(s, JointConfig))
    assert joint.colors


@pytest.fixture
def stood_in(monkeypatch):
    """What reaches renderer and runner, in place of their work."""
    noted = {"rendered": [], "damaged": [], "trained": []}

    def rendered(spec, place):
        noted["rendered"].append((place.name, spec))
        return place

    def damaged(scene, place, damage, seed, second):
        noted["damaged"].append((scene.name, place.name, damage, seed, second))
        place.mkdir(parents=True)

    def trained(pairs, out, samples, at_once, scheduler):
        noted["trained"] += [(data.name, one.name) for data, one in pairs]
        return [
            Outcome(d.name, s.name, {}, {"relit_psnr": 30.0 - 5 * ("6" in d.name)})
            for d, s in pairs
        ]

    monkeypatch.setattr(render, "require", lambda: None)
    monkeypatch.setattr(render, "render", rendered)
    monkeypatch.setattr(suite, "clipped", lambda place: 0.25)
    monkeypatch.setattr(
        suite,
        "damaged",
        lambda scene, out, damage, seed, second: damaged(scene, out, damage, seed, second),
    )
    monkeypatch.setattr(suite.runner, "run_pairs", trained)
    return noted


def test_equal_scenes_and_photographs_are_made_once(stood_in, tmp_path):
    only = ["roughness", "views", "pose", "light", "light-varying"]
    found = suite.stress(tmp_path, only, ["sg", "envmap"], seeds=2)
    assert found == tmp_path / "stress.md"
    scenes = [name for name, _ in stood_in["rendered"]]
    assert scenes == ["base", "roughness-0.3", "roughness-0.1", "roughness-0.03", "base-second"]
    photos = [name for _, name, *_ in stood_in["damaged"]]
    assert len(photos) == len(set(photos))
    # Random ones are made for each seed, others once
    assert {"base", "views-6", "pose-1-s0", "pose-1-s1", "light-0.5-s1"} <= set(photos)
    assert "views-6-s1" not in photos
    assert all((second is not None) == bool(d.light) for *_, d, _, second in stood_in["damaged"])
    trained = stood_in["trained"]
    assert len(trained) == len(set(trained))
    assert trained.count(("base", "sg-s1")) == 1
    assert ("light-0.5-s0", "sg-light-s0") in trained
    # One map from the beginning takes no light that varies: that is told, not trained
    assert ("light-0.5-s0", "envmap-light-s0") not in trained
    record = json.loads((tmp_path / "stress.json").read_text())
    assert record["counts"]["refused"] == 6
    refused = [r for r in record["rows"] if r["fault"]]
    assert {(r["axis"], r["light"]) for r in refused} == {("light-varying", "envmap")}
    point = next(p for p in record["breaking_points"] if (p["axis"], p["light"]) == ("views", "sg"))
    assert point["between"] == ["12", "6"]
    assert point["value"] == pytest.approx(12 * 0.5**0.6)
    assert {p.name for p in tmp_path.iterdir()} >= {"stress.md", "stress.png", "stress.svg"}
    before = len(stood_in["damaged"])
    suite.stress(tmp_path, only, ["sg"], seeds=1)
    assert len(stood_in["damaged"]) == before  # they are there


def test_photographs_of_another_kind_are_not_taken(stood_in, tmp_path, monkeypatch):
    suite.stress(tmp_path, ["views"], quick=True)
    other = dataclasses.replace(
        AXES["views"].levels[-1], damage=dataclasses.replace(INTACT, views=5)
    )
    changed = dataclasses.replace(AXES["views"], levels=(*AXES["views"].levels[:-1], other))
    monkeypatch.setitem(AXES, "views", changed)
    with pytest.raises(ValueError, match=r"views-6/damage\.json: made from other photographs"):
        suite.stress(tmp_path, ["views"], quick=True)


def test_numbers_that_are_none_are_kept_as_text(stood_in, tmp_path, monkeypatch):
    def trained(pairs, *_, **__):
        return [Outcome(d.name, s.name, {}, {"relit_psnr": math.nan}) for d, s in pairs]

    monkeypatch.setattr(suite.runner, "run_pairs", trained)
    suite.stress(tmp_path, ["masks"], quick=True)
    record = json.loads((tmp_path / "stress.json").read_text(), parse_constant=pytest.fail)
    assert {row["fault"] for row in record["rows"]} == {"not finite"}
    assert record["rows"][0]["outcomes"][0]["relit_psnr"] == "nan"
    assert record["axes"]["masks"]["levels"] == ["0", "3"]


def test_quick_is_hybrid_and_one_seed(stood_in, tmp_path):
    suite.stress(tmp_path, ["dark"], quick=True)
    assert stood_in["trained"] == [("base", "hybrid-s0"), ("dark-6", "hybrid-s0")]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--only", "fog"], "--only must be of roughness, metal"),
        (["--light", "moon"], "--light must be of hybrid, sg"),
        (["--seeds", "0"], "--seeds must be at least 1, got 0"),
        (["--set", "sede=1"], "--set sede=1: no field 'sede'"),
    ],
)
def test_mistakes_are_one_line(stood_in, tmp_path, capsys, options, message):
    assert main(["stress", "--out", str(tmp_path / "out"), "--quick", *options]) == 2
    err = capsys.readouterr().err
    assert err.startswith(f"univoxel lab stress: {message}")
    assert err.count("\n") == 1
    assert not stood_in["trained"]


def test_without_mitsuba_one_line_names_the_extra(tmp_path, capsys, monkeypatch):
    real = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda n, *a: None if n == "mitsuba" else real(n, *a)
    )
    assert main(["stress", "--out", str(tmp_path / "out"), "--quick"]) == 2
    said = capsys.readouterr().err
    assert (
        said == "univoxel lab stress: the scenes need Mitsuba 3: pip install 'univoxel[stress]'\n"
    )
    assert not (tmp_path / "out").exists()


def test_a_scene_of_another_kind_is_not_taken(tmp_path):
    (tmp_path / "scene.json").write_text("{}")
    with pytest.raises(ValueError, match=r"scene\.json: made for another scene: remove"):
        render.render(Spec(), tmp_path)


def test_a_renderer_that_dies_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(render, "require", lambda: None)
    monkeypatch.setattr(render, "VARIANTS", ("no_such_variant",))
    monkeypatch.setattr(render.sys, "executable", "false")
    with pytest.raises(RuntimeError, match="scene: Mitsuba could not render it: exit code 1"):
        render.render(Spec(), tmp_path / "scene")
    assert not list(tmp_path.iterdir())


def test_a_small_scene_from_end_to_end(tmp_path, monkeypatch, capfd):
    pytest.importorskip("mitsuba")
    small = {"size": 16, "views": 4, "tests": 1, "samples": 4}
    levels = [
        dataclasses.replace(
            level,
            spec=dataclasses.replace(level.spec, **small),
            damage=dataclasses.replace(level.damage, views=n),
        )
        for level, n in zip(AXES["views"].levels[1:3], (4, 3), strict=True)
    ]
    monkeypatch.setitem(
        AXES,
        "views",
        dataclasses.replace(AXES["views"], levels=tuple(levels), reference=0, quick=(0, 1)),
    )
    monkeypatch.setattr(suite, "SAMPLES", 1)
    monkeypatch.setattr(render, "VARIANTS", ("scalar_rgb",))  # there everywhere, nothing to compile
    arguments = ["stress", "--out", str(tmp_path), "--quick", "--only", "views"]
    assert main([*arguments, *OPTIONS[1:]]) == 0
    assert capfd.readouterr().out.strip().endswith("stress.md")
    record = json.loads((tmp_path / "stress.json").read_text())
    assert record["counts"] == {"trainings": 2, "refused": 0, "not finite": 0, "crashed": 0}
    assert all(row["mean"]["relit_psnr"] > 5 for row in record["rows"])
    # The same command again renders and trains nothing
    monkeypatch.setattr(render, "require", lambda: pytest.fail("it rendered again"))
    monkeypatch.setattr(suite.runner, "run_jobs", lambda *_: pytest.fail("it trained again"))
    monkeypatch.setattr(suite.render, "require", lambda: None)
    assert main([*arguments, *OPTIONS[1:]]) == 0
