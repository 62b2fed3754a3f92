"""A run remembers how its photographs were shrunk, and keeps them."""

import dataclasses
import json
from unittest.mock import Mock

import pytest
from analytic import write_scene
from plain import plain_stage, plain_training

from univoxel.cli.evaluate import evaluate
from univoxel.cli.trainer import train
from univoxel.data import image_cache, load_images, load_photos
from univoxel.errors import UserError
from univoxel.lights import SGConfig
from univoxel.run import kept_photos, photos_of
from univoxel.scene import SceneConfig


@pytest.fixture
def large(monkeypatch):
    """Photographs of 32 pixels are twice as large as grids can use."""
    monkeypatch.setattr(load_images, "FINE", 16)


def config(tmp_path, **changes):
    light = SGConfig(lobes=2, hidden=8, directions=16, directions_eval=16)
    stage = plain_stage(voxels=0.008, iterations=10, share=1.0, rays=64, physical_from=0.5)
    sizes = SceneConfig(4, material_channels=2, hidden=8, sky_nodes=16, light=light)
    data = tmp_path / "data"
    if not data.exists():
        write_scene(data, 6)
    cfg = plain_training(
        data, tmp_path / "run", (stage,), minutes=2.0, scene=sizes, voxel_pixels=0.0
    )
    return dataclasses.replace(cfg, **changes)


def test_what_was_found_is_remembered(tmp_path, large, read, monkeypatch):
    cfg = config(tmp_path)
    run = train(cfg)
    assert json.loads((run / "config.json").read_text())["downscale"] == 2
    assert len(read) == 6
    train(cfg, resume=True)  # which finds the same, and reads what was kept
    assert len(read) == 6
    evaluate(run)
    assert len(read) == 8  # two test views
    evaluate(run)
    assert len(read) == 8
    assert {kept_photos(run, s).is_file() for s in ("train", "test")} == {True}
    # Other data do not take the place of what was kept
    other = write_scene(tmp_path / "other", 6)
    before = kept_photos(run, "train").read_bytes()
    assert photos_of(run, other, "train").cameras.width == 16
    assert kept_photos(run, "train").read_bytes() == before
    # Whatever would be found now, the run goes by what was
    monkeypatch.setattr(load_images, "FINE", 8)
    assert photos_of(run).cameras.width == 16
    assert photos_of(run, split="train").cameras.width == 16
    with pytest.raises(UserError, match="the run was started with another downscale"):
        train(cfg, resume=True)
    train(dataclasses.replace(cfg, downscale=2), resume=True)


@pytest.mark.parametrize("before", [0, None])
def test_runs_from_before_kept_their_photographs_whole(tmp_path, large, before):
    """0 meant 1 then."""
    run = train(config(tmp_path, downscale=1))
    evaluate(run)
    assert not list(run.glob("photographs*"))  # of what is as it was nothing is kept
    path = run / "config.json"
    values = json.loads(path.read_text())
    del values["downscale"]
    path.write_text(json.dumps(values | ({} if before is None else {"downscale": before})))
    assert photos_of(run).cameras.width == 32
    train(config(tmp_path, downscale=1), resume=True)
    path.write_text(json.dumps(values | ({} if before is None else {"downscale": before})))
    with pytest.raises(UserError, match="the run was started with another downscale"):
        train(config(tmp_path), resume=True)


def test_a_run_that_cannot_begin_leaves_nothing(tmp_path, large):
    cfg = config(tmp_path)
    file = cfg.data / "transforms_train.json"
    root = json.loads(file.read_text())
    for k, frame in enumerate(root["frames"]):  # silhouettes that have no common volume
        frame["transform_matrix"][0][3] += 5 * k
    file.write_text(json.dumps(root))
    with pytest.raises(UserError, match="have no common volume"):
        train(cfg)
    assert not cfg.out.exists()


def test_the_disk_may_be_full(tmp_path, large, monkeypatch, caplog):
    caplog.set_level("INFO", "univoxel")

    monkeypatch.setattr(image_cache, "save_file", Mock(side_effect=OSError(28, "no space left")))
    run = train(config(tmp_path))
    assert "prepared photographs could not be stored" in caplog.text
    assert load_photos(tmp_path / "data").downscale == 2
    assert sorted(p.name for p in run.glob("*photographs*")) == []
