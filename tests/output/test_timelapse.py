"""A view over training time, and the training that must not notice it."""

import dataclasses
import sys

import pytest
import torch
from PIL import Image
from tiny import three_stages

from univoxel.cli import trainer as task
from univoxel.cli.trainer import train
from univoxel.data.images import read_image
from univoxel.errors import DataError
from univoxel.lights import EnvmapConfig
from univoxel.output import timelapse as module
from univoxel.output.timelapse import LABEL, Timelapse
from univoxel.scene import load_checkpoint, load_scene
from univoxel.training import clock as clock_module


@pytest.fixture
def often(monkeypatch):
    """A frame after every step."""
    monkeypatch.setattr(module, "FRAMES", 1e9)


@pytest.mark.parametrize(
    "light", [None, EnvmapConfig(rows=8, directions=8, directions_eval=8)], ids=["local", "traced"]
)
def test_training_does_not_notice(data, tmp_path, often, light):
    plain = load_scene(train(three_stages(data, tmp_path / "plain", light=light)))
    frames = f"{tmp_path}/frames.1/"
    seen = load_scene(train(three_stages(data, tmp_path / "seen", light=light), timelapse=frames))
    for name, value in plain.state_dict().items():
        assert torch.equal(value, seen.state_dict()[name]), name
    pictures = sorted((tmp_path / "frames.1").iterdir())
    assert [p.name for p in pictures] == [f"step_{i:06d}.png" for i in range(1, 12 + 6 + 4 + 1)]
    assert len({picture.read_bytes() for picture in pictures}) > 15
    assert read_image(pictures[0]).shape == (24 + LABEL, 3 * 24, 3)


def test_frames_do_not_count_as_time(data, tmp_path, monkeypatch, often):
    class Clock:
        now = 0.0

        def monotonic(self):
            return self.now

    clock, draw = Clock(), module.frame

    def slow(*arguments):
        clock.now += 1000
        return draw(*arguments)

    monkeypatch.setattr(clock_module, "time", clock)
    monkeypatch.setattr(task, "time", clock)
    monkeypatch.setattr(module, "frame", slow)
    run = train(three_stages(data, tmp_path / "run"), timelapse=tmp_path / "frames")
    assert load_checkpoint(run)[1]["seconds"] == 0.0
    assert load_checkpoint(run)[1]["made"] == [1.0, 1.0, 1.0]


def test_a_gif(data, tmp_path, often):
    out = tmp_path / "new" / "film.gif"
    run = train(three_stages(data, tmp_path / "run"), timelapse=out)
    with Image.open(out) as image:
        assert image.n_frames > 10
        assert image.info["duration"] == 100
        assert image.size == (3 * 24, 24 + LABEL)
    assert not (run / "timelapse").exists()


def test_frames_come_at_equal_shares_of_the_work(data, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "FRAMES", 4)
    train(three_stages(data, tmp_path / "run"), timelapse=tmp_path / "frames")
    assert len(list((tmp_path / "frames").iterdir())) == 4 + 1  # and the last


def test_without_test_views_a_training_view_is_shown(data, tmp_path):
    cfg = three_stages(data, tmp_path / "run")
    for name in ("train", "transforms_train.json"):
        (tmp_path / "data").mkdir(exist_ok=True)
        (tmp_path / "data" / name).symlink_to(data / name)
    linked = dataclasses.replace(cfg, data=tmp_path / "data", allow_outside=True)
    alone = Timelapse("a/", linked).cameras
    assert not torch.equal(
        alone.camera_to_world[0], Timelapse("a/", cfg).cameras.camera_to_world[0]
    )


@pytest.mark.parametrize("name", ["film.avi", "film.GIFF"])
def test_another_ending(data, tmp_path, name):
    with pytest.raises(ValueError, match=rf"ends in \.gif, \.mp4 or / \(a folder\), got {name}"):
        train(three_stages(data, tmp_path / "run"), timelapse=name)
    assert not (tmp_path / "run").exists()


def test_what_is_missing_is_said_before_the_work(data, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ImportError, match="an MP4 needs imageio-ffmpeg"):
        train(three_stages(data, tmp_path / "run"), timelapse="film.mp4")
    with pytest.raises(DataError, match="transforms_train"):
        train(three_stages(tmp_path, tmp_path / "run"), timelapse="film.gif")
    assert not (tmp_path / "run").exists()


def test_light_that_varies_is_shown(data, tmp_path, often):
    """The radiance head then reads a code of the view beside the features."""
    cfg = three_stages(data, tmp_path / "run")
    cfg = dataclasses.replace(cfg, scene=dataclasses.replace(cfg.scene, varying="light"))
    train(cfg, timelapse=f"{tmp_path}/frames/")
    assert len(list((tmp_path / "frames").iterdir())) == 12 + 6 + 4
