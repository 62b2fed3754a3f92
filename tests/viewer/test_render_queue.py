"""Who gets pictures, with viewers that are lists; films; and what the server refuses."""

import io
import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from itertools import pairwise
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from PIL import Image

from univoxel.camera import project
from univoxel.data import Photos
from univoxel.data.images import write_exr
from univoxel.envmap import EnvMap
from univoxel.errors import MissingExtra, UserError
from univoxel.output.viewpoints import lighting, orbit
from univoxel.viewer import render_queue as module
from univoxel.viewer.frames import Look
from univoxel.viewer.render_queue import Studio, Viewer, film, kind, turned_about
from univoxel.viewer.server import camera_of, laid_over, light_of_bytes, pose_for_viser, serving
from univoxel.viewer.training import same_site

PATIENCE = 120.0  # seconds, on a loaded machine


@pytest.fixture(scope="module")
def light():
    return lighting(EnvMap(torch.ones(4, 8, 3)))


@pytest.fixture
def studio(subject):
    studio = Studio(subject)
    yield studio
    studio.stop()


@pytest.fixture
def watcher(studio):
    """One who looks."""
    watcher = Watcher()
    studio.join(watcher.viewer)
    return watcher


class Watcher:
    """A viewer that keeps what it is shown."""

    def __init__(self, on_picture=lambda: None):
        self.sizes, self.lines, self.news = [], [], threading.Event()
        self._on_picture = on_picture
        self.viewer = Viewer(self._show, self._complain)

    def _show(self, picture):
        self.sizes.append(tuple(picture.shape))
        self._on_picture()
        self.news.set()

    def _complain(self, line):
        self.lines.append(line)
        self.news.set()

    def wait(self, true):
        until = time.monotonic() + PATIENCE
        while not true():
            assert time.monotonic() < until, (self.sizes, self.lines)
            self.news.wait(0.05)
            self.news.clear()


def test_two_viewers_get_quick_pictures_and_good_ones(studio, subject, light):
    cameras = orbit(subject.traced.mesh, 1, 256)
    both = [Watcher(), Watcher()]
    for watcher in both:
        studio.join(watcher.viewer)
        studio.ask(watcher.viewer, cameras, Look(light))
    for watcher in both:
        watcher.wait(lambda w=watcher: len(w.sizes) >= 3)
        assert watcher.sizes[0][1] < 256  # quick ones are small
        assert watcher.sizes[-1] == (256, 256, 4)


def test_one_leaves_in_the_middle_of_a_picture(studio, subject, light):
    cameras = orbit(subject.traced.mesh, 1, 128)
    stays = Watcher()
    leaves = Watcher(lambda: studio.leave(leaves.viewer))
    for watcher in (leaves, stays):
        studio.join(watcher.viewer)
        studio.ask(watcher.viewer, cameras, Look(light))
    stays.wait(lambda: len(stays.sizes) >= 3)
    assert len(leaves.sizes) == 1


def test_a_mistake_or_a_chore_that_fails_is_one_line(studio, watcher, subject, light, caplog):
    """Expected errors without photographs; then the same viewer asks for what there is."""
    cameras = orbit(subject.traced.mesh, 1, 64)

    def failing(error):
        yield
        raise error

    studio.ask(watcher.viewer, cameras, Look(light, "expected error"))
    watcher.wait(lambda: watcher.lines)
    studio.do(watcher.viewer, "a", failing(OSError("no room")))
    watcher.wait(lambda: len(watcher.lines) == 2)
    studio.do(watcher.viewer, "a", failing(KeyError("a fault")))
    watcher.wait(lambda: len(watcher.lines) == 3)
    assert "photographs" in watcher.lines[0]
    assert watcher.lines[1:] == ["no room", "rendering failed: see the terminal of univoxel"]
    assert "a fault" in caplog.text
    studio.ask(watcher.viewer, cameras, Look(light, "albedo"))  # the studio goes on
    watcher.wait(lambda: watcher.sizes)


def test_chores_go_on_beside_pictures(studio, watcher, subject, light):
    """Step by step; views that move go before; another of the same name takes its place."""
    cameras, seen = orbit(subject.traced.mesh, 1, 64), []

    def chore(name, steps):
        for step in range(steps):
            seen.append((name, step))
            watcher.news.set()
            yield

    studio.ask(watcher.viewer, cameras, Look(light))
    studio.do(watcher.viewer, "a", chore("a", 5))
    studio.do(watcher.viewer, "b", chore("b", 3))
    watcher.wait(lambda: len(seen) == 8 and len(watcher.sizes) >= 3)
    assert sorted(seen) == [("a", i) for i in range(5)] + [("b", i) for i in range(3)]
    assert [step for name, step in seen if name == "a"] == list(range(5))

    begun, held = threading.Event(), threading.Event()

    def ends():
        begun.set()
        held.wait(PATIENCE)
        yield from ()

    studio.do(watcher.viewer, "c", ends())
    assert begun.wait(PATIENCE)
    studio.do(watcher.viewer, "c", chore("c", 1))
    held.set()
    watcher.wait(lambda: seen[-1] == ("c", 0))
    watcher.wait(lambda: "c" not in watcher.viewer.chores)


def test_chores_go_with_their_viewer(studio, watcher):
    ended = threading.Event()

    def chore():
        try:
            while True:
                watcher.news.set()
                yield
        finally:
            ended.set()

    studio.do(watcher.viewer, "a", chore())
    watcher.news.wait(PATIENCE)
    studio.leave(watcher.viewer)
    assert ended.wait(PATIENCE)
    studio.do(watcher.viewer, "a", chore())  # too late
    assert not watcher.viewer.chores


def test_it_listens_on_the_loopback_and_ends(subject, capsys):
    pytest.importorskip("viser")
    with serving(subject, port=0) as address:
        port = int(address.rpartition(":")[2])
        with socket.create_connection(("127.0.0.1", port), 10) as page:
            page.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert page.recv(12) == b"HTTP/1.1 200"
        with socket.create_connection(("127.0.0.1", port), 10) as page:
            page.sendall(b"GET /%2e%2e/%2e%2e/METADATA HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert page.recv(12) == b"HTTP/1.1 404"
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", port), 10)
    assert capsys.readouterr().out == ""


def test_a_socket_of_another_site_is_closed(subject):
    assert same_site("http://localhost:8080", "localhost:8080", "127.0.0.1")
    assert same_site("http://127.0.0.1:9000", "127.0.0.1:9000", "127.0.0.1")  # a forwarded port
    assert same_site(None, "localhost:8080", "127.0.0.1")  # no browser
    assert not same_site("https://example.org", "localhost:8080", "127.0.0.1")
    assert not same_site("http://example.org:8080", "example.org:8080", "127.0.0.1")
    assert same_site("http://studio:8080", "studio:8080", "0.0.0.0")
    assert not same_site("null", "studio:8080", "0.0.0.0")
    viser = pytest.importorskip("viser")
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    with serving(subject, port=0) as address:
        where, protocol = address.replace("http", "ws"), f"viser-v{viser.__version__}"
        with connect(where, origin=address, subprotocols=[protocol]) as own:
            assert own.recv(timeout=PATIENCE)
        with connect(where, origin="https://example.org", subprotocols=[protocol]) as other:
            with pytest.raises(ConnectionClosed) as closed:
                other.recv(timeout=PATIENCE)
            assert closed.value.rcvd.code == 1008


SCRIPT = """
import logging, sys
from asymmetric_scene import lopsided, subject_of
from univoxel.cli.view import command
from univoxel.viewer import viewer_scene

logging.basicConfig(level=logging.INFO, stream=sys.stderr)
subject = subject_of(lopsided(24**3))
viewer_scene.subject_of = lambda run: subject
command("run", port=0)
"""


def test_interrupting_ends_it(tmp_path):
    """Ctrl-C: a line, no traceback, nothing on stdout, exit code 0."""
    pytest.importorskip("viser")
    log = tmp_path / "log"
    path = f"{Path(__file__).parents[1]}{os.pathsep}{Path(__file__).parents[2]}"
    with log.open("w") as err:
        process = subprocess.Popen(
            [sys.executable, "-c", SCRIPT],
            env=os.environ | {"PYTHONPATH": path},
            stdout=subprocess.PIPE,
            stderr=err,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )
    end = time.monotonic() + PATIENCE
    while "Open http://localhost" not in log.read_text():
        assert process.poll() is None
        assert time.monotonic() < end
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=PATIENCE)
    assert (process.returncode, out) == (0, b""), log.read_text()
    assert "Traceback" not in log.read_text()


def test_a_map_that_was_sent(tmp_path):
    dots = dict(zip("RGB", torch.rand(3, 8, 16), strict=True))
    write_exr(tmp_path / "sky.exr", dots, half=False)
    light = light_of_bytes("../x/sky.EXR", (tmp_path / "sky.exr").read_bytes())
    assert light.name == "sky"
    assert torch.equal(light.radiance[..., 0], dots["R"])
    for name, content, said in (
        ("sky.exr", b"nothing", "sky.exr"),
        ("sky.hdr", b"", "sky.hdr"),
        ("sky.txt", b"", "sky.txt: expected an environment map as .hdr or .exr"),
    ):
        with pytest.raises(UserError, match=said) as caught:
            light_of_bytes(name, content)
        assert "/" not in str(caught.value)  # no folder of ours


def test_cameras_go_to_viser_and_back(subject):
    cameras = orbit(subject.traced.mesh, 5, 200)
    for view in range(5):
        wxyz, position, angle, aspect = pose_for_viser(cameras, view)
        assert aspect == 1
        back = camera_of(wxyz, position, angle, 200, 200)
        assert torch.allclose(back.camera_to_world[0], cameras.camera_to_world[view], atol=1e-5)
        assert torch.allclose(back.focal[0], cameras.focal[view], rtol=1e-4)


def test_a_photograph_lies_over_the_render_where_it_was_taken(subject):
    """All of it at share 1, half of it at 0.5; elsewhere, or out of its frame, nothing."""
    cameras = orbit(subject.traced.mesh, 2, 16)
    color = (255 * torch.rand(2, 16, 16, 3)).byte()
    alpha = torch.full((2, 16, 16), 255, dtype=torch.uint8)
    alpha[:, :4] = 0
    photos = Photos(Path("photographs"), ["a", "b"], color, alpha, cameras)
    render = torch.rand(16, 16, 3)
    seen = color[1] / 255
    for share in (1.0, 0.5):
        found = laid_over(render, photos, 1, cameras.of(torch.tensor([1])), share)
        expected = share * seen + (1 - share) * render
        assert torch.allclose(found[4:], expected[4:], atol=1e-4)
        assert torch.equal(found[:4], render[:4])
    assert torch.equal(laid_over(render, photos, 1, cameras.of(torch.tensor([0])), 1.0), render)


# A turn around the object: where cameras stand, and the file that comes of it


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


def looks(layer="albedo"):
    return Look(lighting(EnvMap(torch.ones(4, 8, 3))), layer)


def made(subject, layer="albedo", **options):
    files, shares = [], []
    cameras = orbit(subject.traced.mesh, 1, 48)
    steps = list(film(subject, cameras, looks(layer), files.append, shares.append, **options))
    assert len(steps) > 4  # others are served in between
    assert shares == pytest.approx([(i + 1) / len(shares) for i in range(len(shares))])
    return files


def test_an_mp4_or_else_a_gif(subject, monkeypatch):
    pytest.importorskip("imageio_ffmpeg")
    assert kind() == "mp4"
    (content,) = made(subject, "render", frames=2, samples=2)
    assert content[4:8] == b"ftyp"
    monkeypatch.setattr(module, "require", Mock(side_effect=MissingExtra("no encoder")))
    assert kind() == "gif"
    (content,) = made(subject, frames=4)
    with Image.open(io.BytesIO(content)) as picture:
        assert (picture.format, picture.n_frames, picture.size) == ("GIF", 4, (48, 48))
        frames = []
        for number in range(4):
            picture.seek(number)
            frames.append(torch.tensor(list(picture.convert("RGB").tobytes())).float())
    assert all((a - b).abs().mean() > 1 for a, b in pairwise(frames))


def test_who_goes_leaves_nothing(subject, tmp_path, monkeypatch):
    """A viewer that disconnects in the middle: pictures are gone with it, and no film is sent."""
    monkeypatch.setattr(module.tempfile, "tempdir", str(tmp_path))
    files, cameras = [], orbit(subject.traced.mesh, 1, 48)
    steps = film(subject, cameras, looks(), files.append)
    for _ in range(5):
        next(steps)
    assert list(tmp_path.iterdir())
    steps.close()
    assert not list(tmp_path.iterdir())
    assert files == []
