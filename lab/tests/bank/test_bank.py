"""The bank: what is drawn, what is truth, what counts as right; once from end to end."""

import json
from collections import Counter
from dataclasses import asdict

import numpy as np
import pytest
import torch
from tiny import OPTIONS

from lab.bank import lights, materials, measure, objects, scenes, suite
from lab.record import Outcome
from lab.stress import render
from univoxel.cli import main
from univoxel.data import load_photos, load_truth, relight_maps
from univoxel.sphere import latlong_directions, texel_solid_angles

METAL = {"none": materials.dielectric, "all": materials.metal, "some": materials.partly_metal}


def random(seed=0):
    return np.random.default_rng(seed)


def test_halves_are_fixed_by_the_seed_and_share_no_scene():
    halves = {half: scenes.chosen(3, 64, half) for half in scenes.HALVES}
    assert sorted(halves["tuning"] + halves["judging"]) == list(range(64))
    assert [len(half) for half in halves.values()] == [32, 32]
    assert halves["tuning"][:4] == scenes.chosen(3, 8, "tuning")  # of fewer scenes, the first
    assert halves["tuning"] != scenes.chosen(4, 64, "tuning")
    for half, found in halves.items():
        assert {scenes.drawn(3, index).half for index in found} == {half}


def test_halves_are_asked_the_same_questions():
    drawn = [scenes.drawn(0, index) for index in range(64)]
    for field in ("capture", "metal", "masks"):
        counts = [
            Counter(getattr(d, field) for d in drawn if d.half == half) for half in scenes.HALVES
        ]
        assert counts[0] == counts[1]
        deck = scenes.DECKS[field]
        assert counts[0] == Counter(deck)
    assert {d.family for d in drawn} == set(objects.FAMILIES)
    assert all(24 <= d.views <= 80 for d in drawn)


def test_a_scene_is_drawn_alike_and_other_seeds_are_other_scenes():
    assert scenes.drawn(0, 5) == scenes.drawn(0, 5)
    assert scenes.identity(0, 5) != scenes.identity(1, 5)
    train, test = scenes.cameras_of(scenes.drawn(0, 5))
    again, _ = scenes.cameras_of(scenes.drawn(0, 5))
    torch.testing.assert_close(train.camera_to_world, again.camera_to_world)
    assert len(train) == scenes.drawn(0, 5).views
    assert len(test) == scenes.TESTS


@pytest.mark.parametrize("family", objects.FAMILIES)
def test_objects_are_closed_parts_within_a_ball(family):
    for seed in range(2):
        parts = objects.object_of(
            family, random(seed), lambda role: materials.dielectric(random()), detail=0.3
        )
        assert max(np.linalg.norm(p.vertices, axis=1).max() for p in parts) <= objects.RADIUS + 1e-5
        for part in parts:
            edges = np.concatenate([part.faces[:, [i, (i + 1) % 3]] for i in range(3)])
            keys = [np.sort(e @ [1, len(part.vertices)]) for e in (edges, edges[:, ::-1])]
            assert (keys[0] == keys[1]).all()  # every edge is there both ways
            assert len(part.faces) > 50


@pytest.mark.parametrize("kind", METAL)
def test_materials_are_what_they_are_called(kind):
    points = random().uniform(-0.8, 0.8, (400, 3))
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    shares = []
    for seed in range(30):
        base, roughness, metallic = METAL[kind](random(seed))(points, normals)
        assert base.shape == (400, 3)
        assert ((base >= 0) & (base <= 1)).all()
        assert ((roughness > 0.02) & (roughness <= 1)).all()
        shares.append(metallic.mean())
    low, high = {"none": (0, 0), "all": (1, 1), "some": (0.02, 0.98)}[kind]
    assert low <= np.median(shares) <= high


def test_where_some_is_metal_something_is_not():
    for seed in range(20):
        found = scenes.materials_of_roles("some", ["body", "lid", "rim"], random(seed))
        points = random(1).uniform(-0.8, 0.8, (200, 3))
        metal = [m(points, points)[2].mean() for m in found.values()]
        assert min(metal) == 0
        assert max(metal) > 0


@pytest.mark.parametrize("kind", lights.KINDS)
def test_lights_are_equally_bright_and_have_no_holes(kind):
    rows = lights.ROWS
    grid = latlong_directions(rows).double().numpy()
    weight = texel_solid_angles(rows, 2 * rows).double().numpy()[..., None]
    for seed in range(3):
        found = lights.light(kind, random(seed))
        map = found(grid)
        assert np.isfinite(map).all()
        assert (map >= 0).all()
        assert (map * weight).sum((0, 1)).mean() / (4 * np.pi) == pytest.approx(lights.MIDDLE)


def test_sparks_go_and_highlights_stay():
    picture = np.full((9, 9, 4), 0.2, np.float32)
    picture[..., 3] = 1
    picture[2, 2, :3] = 40.0
    picture[5:7, 5:8, :3] = 3.0
    found = scenes.despeckled(picture)
    assert found[2, 2, 0] == pytest.approx(0.2 * scenes.SPECKLE)
    np.testing.assert_allclose(found[5:7, 5:8], picture[5:7, 5:8])


def test_pieces_are_told_by_what_most_of_them_is():
    part = np.repeat([0, 0, 1], 100)
    true = np.repeat([0.0, 1.0, 1.0], 100)
    metal = np.concatenate([np.linspace(0, 0.6, 100), np.full(100, 0.7), np.full(100, 0.2)])
    assert measure.pieces(metal, true, part) == (2, 3)  # the last is taken for paint
    assert measure.pieces(metal, np.full(300, 0.5), part) == (0, 0)  # neither is not asked about


def test_bins_hold_all_pixels_and_their_errors():
    told, true = torch.tensor([1e-3, 0.05, 11.0, 1e3]), torch.tensor([0.1, 0.3, 0.5, 0.7])
    pairs = [(told[:2], true[:2]), (told[2:], true[2:])]
    table = np.array(measure.binned(pairs, (1.0, 1024.0)))
    np.testing.assert_allclose(table[:, 0], [2, 0, 0, 1, 0, 0, 0, 0, 0, 1])
    np.testing.assert_allclose(table[[0, 3, 9], 2], [0.4, 0.5, 0.7], rtol=1e-3)
    assert measure.binned([], (1.0, 2.0)) is None


def judged(**changed):
    one = {"half": "tuning", "metal": [1, 2], "false_metal": 0.25, "false_mirror": None}
    one |= {key: [False, False] for key in measure.DECISIONS}
    one |= {"calibration": {"albedo": None, "normal": None, "roughness": [[4, 1, 2]] * 10}}
    return one | changed


def test_shares_are_of_those_that_were_asked():
    outcomes = [Outcome(f"s{k}", "draft", {}, {"nvs_psnr": 20.0 + k}) for k in range(3)]
    outcomes.append(Outcome("s3", "draft", {}, error="it fell"))
    found = [judged(flash=[True, False]), judged(flash=[True, True], exposures=None), judged()]
    result = measure.summary(outcomes, [*found, None])
    assert (result["scenes"], result["failed"]) == (4, 1)
    assert result["measures"]["nvs_psnr"] == pytest.approx(21)
    assert result["measures"]["relit_psnr"] is None
    assert result["metal"] == {"right": 0.5, "count": 6}
    assert result["decisions"]["flash"] == pytest.approx(
        {"right": 2 / 3, "found": 0.5, "false": 0.0, "count": 3, "are": 2}
    )
    assert result["decisions"]["exposures"]["count"] == 2
    assert result["calibration"]["roughness"][0] == pytest.approx([0.1, 0.25, 0.5])
    text = measure.markdown({"tuning": result})
    assert "| novel views, dB | 21.00 |" in text
    assert "| ... found where it is (2 scenes) | 0.50 |" in text


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--render", "--judge"], "expected --render or --judge, got both"),
        (["--scenes", "0"], "--scenes must be at least 1 and --seed at least 0, got 0 and 0"),
        (["--judge", "--label", "x"], "seed-0/runs: expected trainings named x, found none"),
    ],
)
def test_mistakes_are_one_line(tmp_path, capsys, options, message):
    assert main(["lab", "bank", "--out", str(tmp_path), *options]) == 2
    err = capsys.readouterr().err
    assert err.startswith("univoxel lab bank: ")
    assert message in err
    assert err.count("\n") == 1


def test_a_small_bank_from_end_to_end(tmp_path, monkeypatch, capfd):
    pytest.importorskip("mitsuba")
    turntable = next(
        i for i in range(64) if scenes.drawn(0, i).capture == "turntable" and i % 2 == 0
    )
    monkeypatch.setattr(render, "VARIANTS", ("scalar_rgb",))  # there everywhere
    worker = (
        "import sys; from pathlib import Path; from lab.bank import objects, scenes; "
        "scenes.SIZE, scenes.SAMPLES, scenes.TEST_SAMPLES = 24, 2, 2; objects.CELLS = 30; "
        "scenes.VIEWS = (4, 5); scenes.work(Path(sys.argv[-2]), sys.argv[-1])"
    )
    real = render.subprocess.run
    monkeypatch.setattr(scenes, "SIZE", 24)
    monkeypatch.setattr(scenes, "VIEWS", (4, 5))

    def run(command, **how):
        return real([command[0], "-c", worker, *command[1:]], **how)

    monkeypatch.setattr(render.subprocess, "run", run)
    monkeypatch.setattr(scenes, "chosen", lambda seed, count, half: [turntable])
    monkeypatch.setattr(suite, "SAMPLES", 1)
    arguments = ["lab", "bank", "--out", str(tmp_path), *OPTIONS[1:]]
    assert main(arguments) == 0
    assert "| right decisions |" in capfd.readouterr().out
    place = tmp_path / "seed-0"
    data = place / "scenes" / scenes.name_of(turntable)
    photos, tests = load_photos(data, "train"), load_photos(data, "test")
    drawn = scenes.drawn(0, turntable)
    assert (len(photos), len(tests)) == (drawn.views, scenes.TESTS)
    assert set(relight_maps(data)) == set(scenes.RELIGHT)
    truth = load_truth(tests, 0)
    assert truth.albedo is not None
    assert truth.mask is not None
    # Silhouettes by rays are those of the renderer
    assert ((tests.picture(0)[1] > 0.99) & ~truth.mask).float().mean() < 0.05
    known = json.loads((data / scenes.TRUTH).read_text())
    assert known["turntable"]
    assert known["drawn"] == json.loads(json.dumps(asdict(drawn)))
    record = json.loads((place / "judge-draft.json").read_text())
    assert record["halves"][drawn.half]["decisions"]["turntable"]["are"] == 1
    # The same again renders and trains nothing
    monkeypatch.setattr(render.subprocess, "run", lambda *_, **__: pytest.fail("rendered again"))
    assert main([*arguments, "--judge"]) == 0
