"""Who gets pictures, with viewers that are lists; and what the server refuses."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import torch
from asymmetric_scene import lopsided, subject_of

from univoxel.data import Photos
from univoxel.data.images import write_exr
from univoxel.envmap import EnvMap
from univoxel.errors import UserError
from univoxel.output.viewpoints import lighting, orbit
from univoxel.viewer.frames import Look
from univoxel.viewer.render_queue import Studio, Viewer
from univoxel.viewer.server import camera_of, laid_over, light_of_bytes, pose_for_viser, serving
from univoxel.viewer.training import same_site

PATIENCE = 120.0  # seconds, on a loaded machine


@pytest.fixture(scope="module")
def subject():
    return subject_of(lopsided(24**3))


@pytest.fixture(scope="module")
def light():
    return lighting(EnvMap(torch.ones(4, 8, 3)))


@pytest.fixture
def studio(subject):
    studio = Studio(subject)
    yield studio
    studio.stop()


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


def test_a_mistake_is_one_line_and_others_go_on(studio, subject, light):
    """Expected errors without photographs; then the same viewer asks for what there is."""
    cameras, watcher = orbit(subject.traced.mesh, 1, 64), Watcher()
    studio.join(watcher.viewer)
    studio.ask(watcher.viewer, cameras, Look(light, "expected error"))
    watcher.wait(lambda: watcher.lines)
    assert len(watcher.lines) == 1
    assert "photographs" in watcher.lines[0]
    studio.ask(watcher.viewer, cameras, Look(light, "albedo"))
    watcher.wait(lambda: watcher.sizes)


def test_chores_go_on_beside_pictures(studio, subject, light):
    """Step by step; views that move go before; another of the same name takes its place."""
    cameras, watcher = orbit(subject.traced.mesh, 1, 64), Watcher()
    studio.join(watcher.viewer)
    seen = []

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

    held = threading.Event()

    def endless():
        while True:
            held.wait(PATIENCE)
            yield

    studio.do(watcher.viewer, "c", endless())
    studio.do(watcher.viewer, "c", chore("c", 1))
    held.set()
    watcher.wait(lambda: seen[-1] == ("c", 0))
    watcher.wait(lambda: "c" not in watcher.viewer.chores)


def test_a_chore_that_fails_is_one_line(studio, subject, light, caplog):
    cameras, watcher = orbit(subject.traced.mesh, 1, 64), Watcher()
    studio.join(watcher.viewer)

    def failing(error):
        yield
        raise error

    studio.do(watcher.viewer, "a", failing(OSError("no room")))
    watcher.wait(lambda: watcher.lines)
    studio.do(watcher.viewer, "a", failing(KeyError("a fault")))
    watcher.wait(lambda: len(watcher.lines) == 2)
    assert watcher.lines == ["no room", "rendering failed: see the terminal of univoxel"]
    assert "a fault" in caplog.text
    studio.ask(watcher.viewer, cameras, Look(light, "albedo"))  # the studio goes on
    watcher.wait(lambda: watcher.sizes)


def test_chores_go_with_their_viewer(studio, subject, light):
    watcher, ended = Watcher(), threading.Event()
    studio.join(watcher.viewer)

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


def test_other_sites_are_refused():
    assert same_site("http://localhost:8080", "localhost:8080", "127.0.0.1")
    assert same_site("http://127.0.0.1:9000", "127.0.0.1:9000", "127.0.0.1")  # a forwarded port
    assert same_site(None, "localhost:8080", "127.0.0.1")  # no browser
    assert not same_site("https://example.org", "localhost:8080", "127.0.0.1")
    assert not same_site("http://example.org:8080", "example.org:8080", "127.0.0.1")
    assert same_site("http://studio:8080", "studio:8080", "0.0.0.0")
    assert not same_site("null", "studio:8080", "0.0.0.0")


def test_a_socket_of_another_site_is_closed(subject):
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
