"""Capacity that follows the scene: grids, and runs from end to end."""

import dataclasses
import json

import pytest
import torch
from analytic import photos_of, write_scene
from plain import plain_stage, plain_training
from spare_scene import LIGHT

from univoxel.cli import trainer as task
from univoxel.cli.info import info
from univoxel.cli.trainer import train
from univoxel.config import JointConfig
from univoxel.lights import EnvmapConfig
from univoxel.scene import FILE, SceneConfig, load_checkpoint, load_scene
from univoxel.training import compression, loop
from univoxel.training.compression import FEWEST_VOXELS


def test_edges_stay_as_sharp_on_a_coarser_grid():
    stage = plain_stage(voxels=0.064, iterations=1, share=1.0, sharpness=(0.6, 0.3))
    box = torch.zeros(3), torch.ones(3)
    same = compression.on_grid(stage, box, compression.fit_grid(*box, 64_000).voxel_size)
    assert same.sharpness == pytest.approx(stage.sharpness)
    coarse = compression.on_grid(stage, box, compression.fit_grid(*box, 8_000).voxel_size)
    assert coarse.sharpness == pytest.approx((0.3, 0.15))  # voxels twice as wide


def test_no_grid_is_finer_than_the_photographs(tmp_path):
    photos = photos_of(3, 48)
    pixel = 1.8 / 48  # a picture is 1.8 wide at the origin
    grids = [plain_stage(voxels=v, iterations=1, share=0.5) for v in (5e-4, 1.0)]
    cfg = plain_training(tmp_path, tmp_path, (grids[0], JointConfig(), grids[1]), minutes=1.0)
    box = torch.tensor([-0.5, -0.5, -1.0]), torch.tensor([0.5, 0.5, 1.0])
    for wide in (1.0, 2.0):
        cut = compression.limited_to_pixels(
            dataclasses.replace(cfg, voxel_pixels=wide), photos.cameras, box
        )
        assert cut.stages[:2] == cfg.stages[:2]
        grid = compression.fit_grid(*box, compression.stage_voxels(cut.stages[2], []))
        assert grid.voxel_size == pytest.approx(wide * pixel, rel=1e-3)
    cut = compression.limited_to_pixels(
        dataclasses.replace(cfg, voxel_pixels=99.0), photos.cameras, box
    )
    assert compression.stage_voxels(cut.stages[2], []) == FEWEST_VOXELS
    free = dataclasses.replace(cfg, voxel_pixels=0.0)
    assert compression.limited_to_pixels(free, photos.cameras, box) == free


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("sphere") / "data")


def config(data, out, light=LIGHT, **changes):
    stages = (
        plain_stage(voxels=0.02, iterations=40, share=0.5, rays=256),
        plain_stage(voxels=0.05, iterations=50, share=0.5, rays=256, physical_from=0.3),
    )
    scene = SceneConfig(channels=4, material_channels=2, hidden=16, light=light, sky_nodes=0)
    cfg = plain_training(data, out, stages, minutes=2.0, scene=scene, capacity="adaptive")
    return dataclasses.replace(cfg, voxel_pixels=0.0, **changes)  # pictures are 32 pixels wide


@pytest.fixture(scope="module")
def run(data, tmp_path_factory):
    return train(config(data, tmp_path_factory.mktemp("adaptive") / "run", budget_mb=0.3))


def test_an_adapted_run_says_what_was_chosen_and_is_read_again(run, tmp_path):
    found = info(run, json=tmp_path / "info.json", picture=tmp_path / "picture.png")
    assert json.loads((tmp_path / "info.json").read_text()) == found
    assert (tmp_path / "picture.png").stat().st_size > 0
    kinds = [c["what"] for c in found["chosen"]]
    assert kinds == ["voxels", "mirror levels", "reach"]
    assert found["bytes"] == (run / FILE).stat().st_size <= 0.3e6
    assert found["grid"]["nodes"] <= 6e4
    assert found["grid"]["share_with_distance"] < 1
    assert any("reach 4 -> " in choice["said"] for choice in found["chosen"])
    assert found["chosen"][0]["said"].startswith("voxels 50,000 -> ")


def test_a_scene_drawn_from_an_adapted_file_is_the_one_that_was_trained(run, data):
    photos = photos_of(12, 32)
    pixels = torch.cartesian_prod(torch.arange(12), torch.arange(32), torch.arange(32))
    # black gives 9 dB, the right sphere in one mean colour 16
    assert loop.held_out_psnr(load_scene(run), photos, pixels, physical=True) > 17


def test_resume_goes_on_with_what_was_chosen(data, tmp_path, monkeypatch):
    cfg = config(data, tmp_path / "run", budget_mb=0.3)
    original, counts = task.run_stage, []

    def killed(scene, cfg, stage, pixels, progress):
        counts.append(scene.field.grid.nodes_count)
        if progress.clock.stage == 1:
            raise KeyboardInterrupt
        original(scene, cfg, stage, pixels, progress)

    monkeypatch.setattr(task, "run_stage", killed)
    with pytest.raises(KeyboardInterrupt):
        train(cfg)
    fits = compression.fit_grid(*load_scene(cfg.out).field.bounds(), 50_000).nodes_count
    assert counts[1] < fits
    with pytest.raises(ValueError, match="the run was started with another budget_mb"):
        train(dataclasses.replace(cfg, budget_mb=1.0), resume=True)
    seen = []
    monkeypatch.setattr(task, "run_stage", lambda scene, *_: seen.append(scene.field.grid))
    train(cfg, resume=True)
    assert [grid.nodes_count for grid in seen] == counts[1:]


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
    assert [c["what"] for c in load_checkpoint(out)[1]["chosen"]] == ["mirror levels", "reach"]


def test_a_picture_of_another_kind_is_refused(run, tmp_path):
    with pytest.raises(ValueError, match=r"picture: expected a .png file, got .*a.jpg"):
        info(run, picture=tmp_path / "a.jpg")
