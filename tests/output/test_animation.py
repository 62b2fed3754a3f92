"""Frames as moving pictures."""

import sys

import numpy as np
import pytest
from PIL import Image

from univoxel.data.images import write_png
from univoxel.output.timelapse import require, write_animation


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


def test_what_is_missing_is_said_before_the_work(monkeypatch):
    require("gif")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ImportError, match=r"imageio-ffmpeg: pip install 'univoxel\[video\]'"):
        require("mp4")
    with pytest.raises(ValueError, match="gif or mp4, got 'webm'"):
        require("webm")
