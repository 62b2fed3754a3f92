"""Which public data set a folder is of, and the tables, with made-up results of trainings."""

import json

import numpy as np
import pytest
from layouts import scene, write_nerf, write_tensoir

from lab import published as module
from lab.record import Outcome
from univoxel.cli import main
from univoxel.data.images import write_png
from univoxel.errors import DataError, ProcessFailed

MEASURES = {"nvs_psnr": 30.0, "nvs_ssim": 0.95, "albedo_psnr_3ch": 25.0, "roughness_mse": 0.01}
MEASURES |= {"relit_psnr": 28.0, "normal_mae_deg": 5.0}
SETS = {"Synthetic4Relight": ["chair", "hotdog"], "TensoIR-Synthetic": ["hotdog"]}
SETS |= {"Shiny Blender": ["car"], "Stanford-ORB": ["cup_scene001"]}


def with_truth(folder, *names):
    write_nerf(folder, scene(3))
    for path in (folder / name for name in names):
        path.parent.mkdir(exist_ok=True)
        write_png(path, np.zeros((8, 12, 4), np.uint8))


@pytest.fixture
def disk(tmp_path):
    """A folder with scenes of each data set, and with some that are of none."""
    lights = [f"test_rli/envmap{n}_p_000.png" for n in (6, 12)]
    for name in SETS["Synthetic4Relight"]:
        with_truth(tmp_path / "disk" / "s4r" / name, "test/p_000_rough.png", *lights)
    (tmp_path / "disk" / "s4r" / "envmap6.exr").touch()
    (tmp_path / "disk" / "s4r" / "hotdog" / "envmap12.exr").touch()
    write_tensoir(tmp_path / "disk" / "tensoir" / "hotdog", scene(3))
    with_truth(tmp_path / "disk" / "shiny" / "car", "test/p_000_normal.png")
    for kind in ("blender_HDR", "blender_LDR"):
        with_truth(tmp_path / "disk" / "orb" / kind / "cup_scene001")
    (tmp_path / "disk" / "orb" / "ground_truth" / "cup_scene001").mkdir(parents=True)
    with_truth(tmp_path / "disk" / "others" / "lego")
    for path in write_tensoir(tmp_path / "disk" / "others" / "nerfactor", scene(3)).glob("*/*.png"):
        path.rename(path.with_name("rgba.png"))
    return tmp_path / "disk"


@pytest.fixture
def trained(monkeypatch):
    """What the runner is asked for, and what it answers by scene in place of `MEASURES`."""
    asked, answers = [], {}

    def run_pairs(pairs, out, *, at_once):
        asked.append((out.name, [path.name for path, _ in pairs], pairs[0][1], at_once))
        out.mkdir(parents=True, exist_ok=True)
        return [answers.get(p.name, Outcome(p.name, s.name, {}, MEASURES)) for p, s in pairs]

    monkeypatch.setattr(module.runner, "run_pairs", run_pairs)
    return asked, answers


def test_the_command_prints_a_table_for_each_data_set(disk, trained, tmp_path, capsys):
    options = ["--out", str(tmp_path / "out"), "--preset", "draft", "--set=seed=1", "--jobs=2"]
    assert main(["lab", "published", str(disk), *options]) == 0
    said = capsys.readouterr().out
    assert said.strip() == (tmp_path / "out" / "published.md").read_text().strip()
    assert {name: scenes for name, scenes, *_ in trained[0]} == SETS
    assert trained[0][0][2:] == (module.Setting("draft", "draft", changes=("seed=1",)), 2)
    relight, tensoir, shiny, orb = said.split("## ")[1:]
    assert "| chair | 30.00 | 0.9500 | 25.00 | 0.0100 | 28.00 |" in relight
    assert "| mean of 2 (published: of 4) | 30.00 | 0.9500 |" in relight
    assert "Not relit under 2 maps but fewer or more: chair 1.\n" in relight
    assert "UniVoxel, 16 SG (MII synthetic, RTX 3090): novel views, dB 36.23;" in relight
    assert "| hotdog | 5.00 | 30.00 | 25.00 | 28.00 |" in tensoir
    assert "| car | 30.00 | 0.9500 | 5.00 |" in shiny
    assert "UniVoxel (Shiny Blender, RTX 3090): normals, degrees 9.30\n" in shiny
    assert "| cup_scene001 | 30.00 |" in orb
    assert said.count("\nProtocol: ") == said.count(" Deviations: ") == 4
    record = json.loads((tmp_path / "out" / "published.json").read_text())
    assert record["means"]["Shiny Blender"]["normal_mae_deg"] == 5.0
    assert [row["maps"] for row in record["rows"]] == [1, 2, 0, 0, 0]
    assert "/blender_HDR/" in record["rows"][-1]["data"]


def test_a_mean_is_over_all_scenes_or_left_out(disk, trained, tmp_path):
    some = MEASURES | {"nvs_psnr": 20.0, "relit_psnr": None}
    trained[1]["chair"] = Outcome("chair", "fast", {}, some)
    path = module.published(disk / "s4r", tmp_path / "out")
    assert "(published: of 4) | 25.00 | 0.9500 | 25.00 | 0.0100 | - |" in path.read_text()
    trained[1]["chair"] = Outcome("chair", "fast", {}, error="it | broke")
    with pytest.raises(
        ProcessFailed, match=r"1 of 2 training runs failed; .*broke; the tables: .*md"
    ):
        module.published(disk / "s4r", tmp_path / "out")
    assert "| chair | failed: it / broke |" in path.read_text()
    assert "(published: of 4) | - | - | - | - | - |" in path.read_text()


def test_folders_that_cannot_be_used(disk, trained, tmp_path, capsys):
    for folder in (disk / "others", tmp_path / "missing"):
        assert main(["lab", "published", str(folder), "--out", str(tmp_path / "out")]) == 2
        (said,) = capsys.readouterr().err.splitlines()
        assert f"{folder}: expected scenes of public data sets, got none" in said
        assert all(f"{which.name} ({which.looked_for})" in said for which in module.SETS)
    with_truth(disk / "copy" / "car", "test/p_000_normal.png")
    with pytest.raises(DataError, match=r"each scene of Shiny Blender once, got .*copy/car"):
        module.published(disk, tmp_path / "out")
    assert trained[0] == []
