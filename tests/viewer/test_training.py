"""A training that browsers look at: it does not notice, and can be ended from there."""

import dataclasses
import socket
import sys
import time
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from asymmetric_scene import lopsided
from browser import browser, installed
from tiny import three_stages

from univoxel.cli import main
from univoxel.cli.train import Train
from univoxel.cli.trainer import train
from univoxel.data import load_photos
from univoxel.errors import MissingExtra, UserError
from univoxel.output.timelapse import LABEL
from univoxel.preparation import pose_refinement
from univoxel.scene import load_checkpoint, load_scene
from univoxel.training import progress as progress_module
from univoxel.training.clock import Clock
from univoxel.training.progress import TrainingProgress
from univoxel.viewer import training as module
from univoxel.viewer.training import Spectators, fitted, watched, words

pytest.importorskip("viser")
ANY = ("127.0.0.1", 0)


class Client:
    """A browser, or what is left of one."""

    def __init__(self, broken=False):
        self.broken, self.pictures = broken, []
        self.camera, self.scene = SimpleNamespace(aspect=2.0), self

    def set_background_image(self, picture):
        if self.broken:
            raise ConnectionResetError("gone")
        self.pictures.append(picture)


@pytest.fixture
def looking(monkeypatch):
    """Clients that look after every step."""
    clients = {0: Client(broken=True), 1: Client()}
    monkeypatch.setattr(module, "EVERY", 0.0)
    monkeypatch.setattr(module, "SHARE", 1e9)
    monkeypatch.setattr("viser.ViserServer.get_clients", lambda self: clients)
    return clients[1]


def assert_same(scene, run):
    for name, value in load_scene(run).state_dict().items():
        assert torch.equal(value, scene.state_dict()[name]), name


def test_training_does_not_notice(data, tmp_path, looking, plain):
    assert_same(plain, train(three_stages(data, tmp_path / "run"), view=ANY))
    assert len(looking.pictures) == 12 + 6 + 4
    picture = looking.pictures[-1]
    assert picture.dtype == np.uint8
    assert picture.shape[1] == 4 * 24
    assert picture.shape[0] == 2 * 24  # in a window twice as wide as high
    tiles = picture[(48 - 24 - LABEL) // 2 + LABEL :][:24].reshape(24, 4, 24, 3)
    photo = load_photos(data, "train").color[0].numpy()
    inside = load_photos(data, "train").alpha[0].numpy() > 0
    assert np.abs(tiles[:, 0][inside].astype(int) - photo[inside]).max() <= 2
    assert all(tiles[:, k].std() > 5 for k in range(4))
    assert len({p.tobytes() for p in looking.pictures}) > 15


def test_a_view_that_fails_is_told_once_and_training_goes_on(
    data, tmp_path, looking, plain, monkeypatch, caplog
):
    monkeypatch.setattr(module, "frame", Mock(side_effect=RuntimeError("no such picture")))
    assert_same(plain, train(three_stages(data, tmp_path / "run"), view=ANY))
    assert looking.pictures == []
    assert caplog.text.count("training continues") == 1
    assert caplog.text.count("RuntimeError: no such picture") == 1


def test_nothing_is_rendered_where_nobody_looks(data, tmp_path, plain, monkeypatch):
    monkeypatch.setattr(module, "EVERY", 0.0)
    monkeypatch.setattr(module, "frame", lambda *arguments: pytest.fail("rendered"))
    assert_same(plain, train(three_stages(data, tmp_path / "run"), view=ANY))


def test_pictures_are_rare_where_they_are_slow(monkeypatch):
    """At most every EVERY seconds, and at most SHARE of the time."""
    clock = SimpleNamespace(now=100.0)
    clock.monotonic = lambda: clock.now
    monkeypatch.setattr(module, "time", clock)
    for cost, expected in ((0.01, module.EVERY), (2.0, 2.0 / module.SHARE)):
        with watched(*ANY, "run") as spectators:
            times = []

            def slow(*arguments, cost=cost, times=times):
                times.append(clock.now)
                clock.now += cost
                return np.zeros((4, 4, 3), np.uint8)

            spectators._picture = slow
            spectators._server = SimpleNamespace(get_clients=lambda: {0: Client()})
            spectators._photos = object()
            for _ in range(3000):
                spectators.look(None, SimpleNamespace(finished=False))
                clock.now += 0.05
        assert len(times) > 2
        assert np.diff(times) == pytest.approx(expected + cost, abs=0.11)


def test_a_training_is_ended_from_a_browser(data, tmp_path, looking, caplog):
    """With all that a training leaves; later stages are made too, if in fewer steps."""
    caplog.set_level("INFO", "univoxel")
    asked = []

    class Stops(Spectators):
        def look(self, scene, clock):
            if clock.step == 5 and not asked:
                self.stop()
                asked.append(clock.step)
            super().look(scene, clock)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "Spectators", Stops)
        cfg = dataclasses.replace(
            three_stages(data, tmp_path / "run", iterations=100_000), minutes=1.0
        )
        run = train(cfg, view=ANY)
    scene, state = load_checkpoint(run)
    assert state["finished"]
    assert state["stage"] == 3
    assert state["made"][0] < 0.5
    assert state["made"][1:] == [1.0, 1.0]
    assert len(scene.field.isosurface()[0]) > 100
    assert "Mean expected error of the surface" in (run / "trust.txt").read_text()
    assert "Result: unfinished, training was stopped (completed steps:" in caplog.text


def test_light_that_varies_and_cameras_that_move(data, tmp_path, looking, monkeypatch):
    monkeypatch.setattr(pose_refinement, "STEPS", 10)
    cfg = three_stages(data, tmp_path / "run", varying="light")
    train(dataclasses.replace(cfg, cameras="refined"), view=ANY)
    assert len(looking.pictures) == 12 + 6 + 4


def test_the_port_is_taken_which_is_said_before_anything(tmp_path, capfd):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        missing = tmp_path / "photographs"
        with pytest.raises(UserError, match=f"^127.0.0.1:{port} is in use"):
            train(three_stages(missing, tmp_path / "run"), view=("127.0.0.1", port))
        arguments = ["train", str(missing), "--out", str(tmp_path / "run")]
        assert main([*arguments, "--view", "--port", str(port)]) == 2
        said = capfd.readouterr().err
        assert said.startswith(f"univoxel train: 127.0.0.1:{port} is in use")
        assert said.count("\n") == 1
        assert not (tmp_path / "run").exists()
        for option in (["--port", str(port)], ["--host", "0.0.0.0"]):
            assert main([*arguments, *option]) == 2
            said = capfd.readouterr().err
            assert said == f"univoxel train: {' '.join(option)} has no effect without --view\n"
    where = {"data": missing, "out": tmp_path / "run"}
    assert Train(**where).view_at() is None
    assert Train(**where, view=True).view_at() == ("127.0.0.1", 8080)
    assert Train(**where, view=True, host="0.0.0.0", port=0).view_at() == ("0.0.0.0", 0)


def test_without_viser(data, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingExtra, match=r"univoxel\[view\]"):
        train(three_stages(data, tmp_path / "run"), view=ANY)
    assert not (tmp_path / "run").exists()


def test_reports_become_curves(data, tmp_path, monkeypatch):
    monkeypatch.setattr(progress_module, "REPORT_SECONDS", 0.0)
    seen = []

    class Told(Spectators):
        def tell(self, now):
            super().tell(now)
            seen.append((self._curves.content, self._status.content, self._share.value))

    mine = []
    monkeypatch.setattr(module, "Spectators", Told)
    train(three_stages(data, tmp_path / "run"), view=ANY, on_progress=mine.append)
    assert len(mine) == len(seen) > 15
    curves, status, share = seen[-1]
    assert curves.count("<svg") == 2
    assert status.startswith("Polish, stage 3 of 3, ")
    assert share == pytest.approx(100 * mine[-1].share)
    assert curves.count('class="stage"') == 4  # two ends in two charts


def test_words():
    now = TrainingProgress(2, 4, "shape", 0.41, 60.0, 75.0, {"a": 1.0}, 31.25, 1e4)
    assert words(now, False) == "Shape, stage 2 of 4, 41%, about 1:15 left, validation 31.2 dB."
    assert words(now, True).endswith(f" {module.ENDING}")
    assert "dB" not in words(dataclasses.replace(now, held_out_psnr=None), False)


def test_a_picture_in_a_window():
    for aspect, size in ((4.0, (10, 40)), (1.0, (20, 20)), (0.0, (10, 20))):
        whole = fitted(np.full((10, 20, 3), 255, np.uint8), aspect)
        assert whole.shape[:2] == size
        assert (whole == 255).all(2).sum() == 200


@pytest.mark.skipif(installed() is None, reason="needs a browser, such as Debian's chromium")
def test_in_a_browser(data, tmp_path, monkeypatch):
    """A picture comes, and a click on the button ends the training."""
    monkeypatch.setattr(module, "EVERY", 0.2)
    scene, photos = lopsided(24**3), load_photos(data, "train")
    cfg = three_stages(data, tmp_path / "run")
    clock = Clock(cfg, time.monotonic(), {})
    with watched(*ANY, "run") as spectators, browser() as tab:
        spectators.show(photos)
        spectators.look(scene, clock)  # nobody is there
        tab.open(spectators.address, 900, 500)
        end = time.monotonic() + 120
        while tab.screenshot()[100:400, 50:500].std() < 20:
            assert time.monotonic() < end
            spectators.look(scene, clock)
            time.sleep(0.1)
        now = TrainingProgress(1, 3, "shape", 0.1, 6.0, 60.0, {"a": 1.0}, 20.0, 1e4)
        spectators.tell(now)
        find = "[...document.querySelectorAll('button')].find(b => b.innerText.includes('end tr'))"
        shown = "document.body.innerText.includes('Shape, stage 1')"
        while not tab.run(f"Boolean({find}) && {shown}"):
            assert time.monotonic() < end
            time.sleep(0.1)
        tab.run(f"{find}.click()")
        while not clock.finished:
            assert time.monotonic() < end
            spectators.look(scene, clock)
            time.sleep(0.1)
        ours = (spectators.address, "data:", "blob:")
        assert [url for url in tab.requests if not url.startswith(ours)] == []
