"""A view over training time, the training that must not notice it, and moving pictures."""

import dataclasses
import sys

import numpy as np
import pytest
import torch
from PIL import Image
from tiny import three_stages

from univoxel.cli import trainer as task
from univoxel.cli.trainer import train
from univoxel.data.images import read_image, write_png
from univoxel.errors import DataError
from univoxel.lights import EnvmapConfig
from univoxel.output import timelapse as module
from univoxel.output.timelapse import LABEL, Timelapse, require, write_animation
from univoxel.scene import load_checkpoint, load_scene
from univoxel.training import clock as clock_module


@pytest.fixture
def often(monkeypatch):
    """A frame after every step."""
    monkeypatch.setattr(module, "FRAMES", 1e9)


@pytest.mark.parametrize(
    "light", [None, EnvmapConfig(rows=8, directions=8, directions_eval=8)], ids=["local", "traced"]
)
def test_training_does_not_notice(data, plain, tmp_path, often, light):
    if light is not None:
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


def test_a_gif_of_a_training(data, tmp_path, often):
    out = tmp_path / "new" / "film.gif"
    run = train(three_stages(data, tmp_path / "run"), timelapse=out)
    with Image.open(out) as image:
        assert image.n_frames > 10
        assert image.info["duration"] == 100
        assert image.size == (3 * 24, 24 + LABEL)
    assert not (run / "timelapse").exists()


def test_frames_come_at_equal_shares_of_the_work(data, tmp_path, monkeypatch):
    """Also where light varies: the radiance head then reads a code of the view, too."""
    monkeypatch.setattr(module, "FRAMES", 4)
    cfg = three_stages(data, tmp_path / "run", varying="light")
    train(cfg, timelapse=tmp_path / "frames")
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


def test_what_is_missing_is_said_before_the_work(data, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ImportError, match="an MP4 needs imageio-ffmpeg"):
        train(three_stages(data, tmp_path / "run"), timelapse="film.mp4")
    with pytest.raises(DataError, match="transforms_train"):
        train(three_stages(tmp_path, tmp_path / "run"), timelapse="film.gif")
    for name in ("film.avi", "film.GIFF"):
        with pytest.raises(ValueError, match=rf"ends in \.gif, \.mp4 or / .*, got {name}"):
            train(three_stages(data, tmp_path / "run"), timelapse=name)
    assert not (tmp_path / "run").exists()


# Frames as moving pictures


@pytest.fixture
def frames(tmp_path):
    paths = []
    for i in range(3):
        image = np.zeros((7, 9, 4), np.float32)
        image[..., i] = image[2:, :, 3] = 1.0
        image[:2] = 0  # transparent rows: white in the end
        paths.append(tmp_path / f"{i}.png")
        write_png(paths[-1], image)
    return paths


def test_gif(frames, tmp_path):
    write_animation(tmp_path / "a.gif", frames)
    with Image.open(tmp_path / "a.gif") as image:
        assert (image.n_frames, image.size, image.info["loop"]) == (3, (9, 7), 0)
        assert image.info["duration"] == 40
        assert image.convert("RGB").getpixel((0, 0)) == (255, 255, 255)
        assert image.convert("RGB").getpixel((0, 6)) == (255, 0, 0)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["0.png", "1.png", "2.png", "a.gif"]


def test_mp4(frames, tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    write_animation(tmp_path / "a.mp4", frames)
    count, _ = ffmpeg.count_frames_and_secs(str(tmp_path / "a.mp4"))
    assert count == 3


def test_what_is_missing_for_a_kind_is_said(monkeypatch):
    require("gif")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ImportError, match=r"imageio-ffmpeg: pip install 'univoxel\[video\]'"):
        require("mp4")
    with pytest.raises(ValueError, match="gif or mp4, got 'webm'"):
        require("webm")
