"""Capacity that follows the scene: grids, and runs from end to end."""

import dataclasses
import json

import pytest
import torch
from analytic import photos_of, sphere_scene, write_scene
from spare_scene import LIGHT

from univoxel.checkpoint import FILE, load_checkpoint, load_scene
from univoxel.compression import plan
from univoxel.compression.config import CompressionConfig
from univoxel.config import TrainConfig
from univoxel.joint.config import JointConfig
from univoxel.lights import EnvmapConfig
from univoxel.scene import SceneConfig
from univoxel.tasks import train as task
from univoxel.tasks.info import info
from univoxel.tasks.train import train
from univoxel.training import loop
from univoxel.training.config import StageConfig
from univoxel.training.pixels import TrainingPixels
from univoxel.training.progress import Rehearsal

CFG = CompressionConfig()


@pytest.mark.parametrize(
    ("quality", "chosen"),
    [
        # voxels: PSNR; a ninth at a time from 364,500, then a third of the chosen
        ({364_500: 30.0, 40_500: 30.0, 4_500: 30.0}, 4_500),  # a plain scene: the coarsest
        ({364_500: 30.0, 40_500: 29.8, 4_500: 29.0, 121_500: 29.8}, 364_500),  # finer pays
        ({364_500: 30.0, 40_500: 29.8, 4_500: 29.0, 121_500: 29.95}, 121_500),  # a little less
        ({364_500: 30.0, 40_500: 29.8, 4_500: 29.95}, 4_500),  # between, chance had it
        ({364_500: 30.0, 40_500: 30.5, 4_500: 30.3, 13_500: 30.39}, 40_500),  # against the best
    ],
)
def test_a_grid_is_as_coarse_as_its_rehearsal_allows(quality, chosen, tmp_path, monkeypatch):
    scene = sphere_scene(0, voxel_size=0.1)
    box = scene.field.bounds()
    counts = {plan.fit_grid(*box, n): n for n in quality}

    stage = StageConfig(voxels=0.3645, iterations=40, share=1.0)
    cfg = TrainConfig(tmp_path, tmp_path, (stage, stage), minutes=1.0)
    pixels = TrainingPixels(photos_of(2, 8), torch.zeros(1, 3), torch.zeros(1, 3))

    def rehearse(cfg_, pixels_, tried, on_grid, steps):
        assert (cfg_, pixels_, steps) == (cfg, pixels, 8)
        assert on_grid == plan.on_grid(stage, box, tried.field.voxel_size)
        with torch.no_grad():
            tried.material.net.linear[-1].bias[0] = counts[tried.field.grid]
        return quality[counts[tried.field.grid]]

    monkeypatch.setattr(plan, "rehearsal", rehearse)
    (choice,) = plan.choose_grid_(scene, cfg, stage, box, pixels, pace=1.0)
    assert (choice.kind, choice.before, choice.after) == ("voxels", 364_500, chosen)
    assert counts[scene.field.grid] == chosen
    assert scene.material.net.linear[-1].bias[0] == chosen  # it goes on from that rehearsal
    assert "364,500 30.00 dB" in choice.why


def test_a_rehearsal_is_off_the_record():
    rehearsal = Rehearsal(4)
    assert list(rehearsal.clock.steps()) == [0, 0.25, 0.5, 0.75]
    assert rehearsal.clock.step == 4
    assert not rehearsal.due()
    assert not rehearsal.checkpoint_due()


def test_edges_stay_as_sharp_on_a_coarser_grid():
    stage = StageConfig(voxels=0.064, iterations=1, share=1.0, sharpness=(0.6, 0.3))
    box = torch.zeros(3), torch.ones(3)
    same = plan.on_grid(stage, box, plan.fit_grid(*box, 64_000).voxel_size)
    assert same.sharpness == pytest.approx(stage.sharpness)
    coarse = plan.on_grid(stage, box, plan.fit_grid(*box, 8_000).voxel_size)
    assert coarse.sharpness == pytest.approx((0.3, 0.15))  # voxels twice as wide


def test_no_grid_is_finer_than_the_photographs(tmp_path):
    photos = photos_of(3, 48)
    pixel = 1.8 / 48  # a picture is 1.8 wide at the origin
    grids = [StageConfig(voxels=v, iterations=1, share=0.5) for v in (5e-4, 1.0)]
    cfg = TrainConfig(tmp_path, tmp_path, (grids[0], JointConfig(), grids[1]), minutes=1.0)
    box = torch.tensor([-0.5, -0.5, -1.0]), torch.tensor([0.5, 0.5, 1.0])
    for wide in (1.0, 2.0):
        cut = plan.limited_to_pixels(
            dataclasses.replace(cfg, voxel_pixels=wide), photos.cameras, box
        )
        assert cut.stages[:2] == cfg.stages[:2]
        grid = plan.fit_grid(*box, plan.stage_voxels(cut.stages[2], []))
        assert grid.voxel_size == pytest.approx(wide * pixel, rel=1e-3)
    cut = plan.limited_to_pixels(dataclasses.replace(cfg, voxel_pixels=99.0), photos.cameras, box)
    assert plan.stage_voxels(cut.stages[2], []) == CFG.fewest_voxels
    free = dataclasses.replace(cfg, voxel_pixels=0.0)
    assert plan.limited_to_pixels(free, photos.cameras, box) == free


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("sphere") / "data")


def config(data, out, light=LIGHT, **changes):
    stages = (
        StageConfig(voxels=0.02, iterations=40, share=0.5, rays=256),
        StageConfig(voxels=0.05, iterations=50, share=0.5, rays=256, physical_from=0.3),
    )
    scene = SceneConfig(channels=4, material_channels=2, hidden=16, light=light, sky_nodes=0)
    cfg = TrainConfig(data, out, stages, minutes=2.0, scene=scene, capacity="adaptive")
    return dataclasses.replace(cfg, voxel_pixels=0.0, **changes)  # pictures are 32 pixels wide


@pytest.fixture(scope="module")
def run(data, tmp_path_factory):
    return train(config(data, tmp_path_factory.mktemp("adaptive") / "run", budget_mb=0.3))


def test_an_adapted_run_says_what_was_chosen_and_is_read_again(run, tmp_path):
    found = info(run, json=tmp_path / "info.json", picture=tmp_path / "picture.png")
    assert json.loads((tmp_path / "info.json").read_text()) == found
    assert (tmp_path / "picture.png").stat().st_size > 0
    kinds = [c["what"] for c in found["chosen"]]
    assert kinds[:2] == ["voxels", "channels"]
    assert "reach" in kinds
    assert found["bytes"] == (run / FILE).stat().st_size <= 0.3e6
    scene = load_scene(run)
    assert scene.cfg.channels == found["channels"] == scene.field.features.shape[-1]
    assert found["grid"]["nodes"] <= 6e4
    assert found["grid"]["share_with_distance"] < 1
    assert any("reach 4 -> " in choice["said"] for choice in found["chosen"])


def test_a_scene_drawn_from_an_adapted_file_is_the_one_that_was_trained(run, data):
    photos = photos_of(12, 32)
    pixels = torch.cartesian_prod(torch.arange(12), torch.arange(32), torch.arange(32))
    # black gives 9 dB, the right sphere in one mean colour 16
    assert loop.held_out_psnr(load_scene(run), photos, pixels, physical=True) > 17


def test_the_log_tells_of_choices(run):
    state = load_checkpoint(run)[1]
    assert state["chosen"][0]["said"].startswith("voxels 50,000 -> ")


def test_resume_goes_on_with_what_was_chosen(data, tmp_path, monkeypatch):
    cfg = config(data, tmp_path / "run")
    original, counts = task.run_stage, []

    def killed(scene, cfg, stage, pixels, progress):
        if not isinstance(progress, Rehearsal):
            if progress.clock.stage == 1:
                raise KeyboardInterrupt
            original(scene, cfg, stage, pixels, progress)
        # A rehearsal: the third grid serves as well as the first
        counts.append(scene.field.grid.nodes_count)

    for module in (task, loop):  # stages, and their rehearsals
        monkeypatch.setattr(module, "run_stage", killed)
    monkeypatch.setattr(loop, "held_out_psnr", lambda *_, **__: 20.0)
    with pytest.raises(KeyboardInterrupt):
        train(cfg)
    coarsest = counts[-1]
    assert coarsest < counts[1]
    with pytest.raises(ValueError, match="the run began with other capacity"):
        train(dataclasses.replace(cfg, capacity="fixed"), resume=True)
    seen = []
    monkeypatch.setattr(task, "run_stage", lambda scene, *_: seen.append(scene.field.grid))
    train(cfg, resume=True)
    assert [grid.nodes_count for grid in seen] == [coarsest]


@pytest.fixture(scope="module")
def hashed(data, tmp_path_factory):
    cfg = config(data, tmp_path_factory.mktemp("hashed") / "run", budget_mb=0.3)
    stages = tuple(dataclasses.replace(s, field="hash") for s in cfg.stages)
    return train(dataclasses.replace(cfg, stages=stages))


def test_a_hash_table_is_adapted_by_rows(hashed, data):
    found = info(hashed)
    assert [c["what"] for c in found["chosen"]].count("rows") == 1
    assert found["bytes"] == (hashed / FILE).stat().st_size <= 0.3e6
    scene = load_scene(hashed)
    assert scene.field.kind == "hash"
    # Unless the budget took some more, the file has those rows that were kept, and no others
    rows = next(c for c in found["chosen"] if c["what"] == "rows")
    assert 0 < int(scene.field.features.any(1).sum()) <= rows["after"] <= rows["before"]
    pixels = torch.cartesian_prod(torch.arange(12), torch.arange(32), torch.arange(32))
    # as above
    assert loop.held_out_psnr(scene, photos_of(12, 32), pixels, physical=True) > 17


def test_a_light_without_networks_is_adapted_too(data, tmp_path):
    light = EnvmapConfig(rows=8, directions=8, directions_eval=8)
    cfg = config(data, tmp_path / "run", light)
    stages = tuple(dataclasses.replace(s, iterations=8, rays=64) for s in cfg.stages)
    out = train(dataclasses.replace(cfg, stages=stages))
    assert [c["what"] for c in load_checkpoint(out)[1]["chosen"]][:2] == ["voxels", "channels"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"capacity": "elastic"}, "capacity must be fixed or adaptive, got 'elastic'"),
        ({"budget_mb": -1.0}, "budget_mb must be above 0 or None, got -1"),
        ({"budget_mb": 1.0, "capacity": "fixed"}, "budget_mb 1 needs adaptive capacity"),
    ],
)
def test_bad_configurations(data, tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        config(data, tmp_path / "run", **changes)


def test_a_picture_of_another_kind_is_refused(run, tmp_path):
    with pytest.raises(ValueError, match=r"picture: expected a .png file, got .*a.jpg"):
        info(run, picture=tmp_path / "a.jpg")
