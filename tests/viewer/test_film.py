"""A turn around the object: where cameras stand, and the file that comes of it."""

import io
import math
from itertools import pairwise
from unittest.mock import Mock

import pytest
import torch
from asymmetric_scene import lopsided, subject_of
from PIL import Image

from univoxel.camera import project
from univoxel.envmap import EnvMap
from univoxel.errors import MissingExtra
from univoxel.output.viewpoints import lighting, orbit
from univoxel.viewer import render_queue as module
from univoxel.viewer.frames import Look
from univoxel.viewer.render_queue import film, kind, turned_about


@pytest.fixture(scope="module")
def subject():
    return subject_of(lopsided(24**3))


@pytest.fixture
def without_encoder(monkeypatch):
    monkeypatch.setattr(module, "require", Mock(side_effect=MissingExtra("no encoder")))


def test_cameras_go_round_a_vertical_axis(subject):
    """A quarter turn is what an orbit of four has; points of the axis stay in their pixel."""
    cameras = orbit(subject.traced.mesh, 4, 64)
    low, high = subject.traced.mesh.vertices.amin(0), subject.traced.mesh.vertices.amax(0)
    middle = (low + high) / 2
    first = cameras.of(torch.tensor([0]))
    turned = turned_about(first, middle, math.pi / 2)
    torch.testing.assert_close(turned.camera_to_world[0], cameras.camera_to_world[1])
    axis = middle + torch.tensor([[0.0, 0, 0.1], [0, 0, -0.2]])
    for angle in (0.3, 2.0):
        pixel, depth = project(turned_about(first, middle, angle), 0, axis)
        torch.testing.assert_close(pixel, project(first, 0, axis)[0])
        torch.testing.assert_close(depth, project(first, 0, axis)[1])


def made(subject, layer="albedo", **options):
    files, shares = [], []
    cameras = orbit(subject.traced.mesh, 1, 48)
    look = Look(lighting(EnvMap(torch.ones(4, 8, 3))), layer)
    steps = list(film(subject, cameras, look, files.append, shares.append, **options))
    assert len(steps) > 4  # others are served in between
    assert shares == pytest.approx([(i + 1) / len(shares) for i in range(len(shares))])
    return files


def test_a_gif(subject, without_encoder):
    assert kind() == "gif"
    (content,) = made(subject, frames=4)
    with Image.open(io.BytesIO(content)) as picture:
        assert (picture.format, picture.n_frames, picture.size) == ("GIF", 4, (48, 48))
        frames = []
        for number in range(4):
            picture.seek(number)
            frames.append(torch.tensor(list(picture.convert("RGB").tobytes())).float())
    assert all((a - b).abs().mean() > 1 for a, b in pairwise(frames))


def test_an_mp4(subject):
    pytest.importorskip("imageio_ffmpeg")
    assert kind() == "mp4"
    (content,) = made(subject, "render", frames=2, samples=2)
    assert content[4:8] == b"ftyp"


def test_who_goes_leaves_nothing(subject, tmp_path, monkeypatch):
    """A viewer that disconnects in the middle: pictures are gone with it, and no film is sent."""
    monkeypatch.setattr(module.tempfile, "tempdir", str(tmp_path))
    files = []
    cameras = orbit(subject.traced.mesh, 1, 48)
    steps = film(
        subject, cameras, Look(lighting(EnvMap(torch.ones(4, 8, 3))), "albedo"), files.append
    )
    for _ in range(5):
        next(steps)
    assert list(tmp_path.iterdir())
    steps.close()
    assert not list(tmp_path.iterdir())
    assert files == []
