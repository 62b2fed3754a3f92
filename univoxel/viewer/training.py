"""A training in the browser while it runs, and the server with its access rules."""

from __future__ import annotations

import contextlib
import html
import io
import socket
import threading
import time
from collections.abc import Iterator, Mapping
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import torch

from univoxel.camera import resize
from univoxel.color import linear_to_srgb
from univoxel.core import log
from univoxel.core.html import Curve, chart
from univoxel.data import Photos
from univoxel.errors import MissingExtra, UserError
from univoxel.output.timelapse import LAYERS, frame, labelled, shown
from univoxel.render.pictures import shrunk
from univoxel.scene import Scene
from univoxel.training.clock import Clock
from univoxel.training.progress import TrainingProgress

HOST = "127.0.0.1"
PORT = 8080
LOOPBACK = ("127.0.0.1", "localhost", "::1")


@contextlib.contextmanager
def hosted(host: str, port: int, title: str) -> Iterator[Any]:
    """A block in which a server answers browsers; gives it. Nothing of it is left afterwards. A
    MissingExtra without viser, a UserError where the port is taken."""
    try:
        import viser
    except ImportError:
        raise MissingExtra("the viewer needs viser: pip install 'univoxel[view]'") from None
    _require_port(host, port)
    with _silent():
        server = viser.ViserServer(host=host, port=port, verbose=False)
    try:
        if port and server.get_port() != port:  # taken in between; viser continues to the next
            raise _taken(host, port)
        _guard(server, host)
        server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        server.gui.set_panel_label(title)
        yield server
    finally:
        with _silent():
            server.stop()


def address_of(server: Any, host: str) -> str:
    """Where browsers find a server that listens on `host`."""
    return f"http://{'localhost' if host in LOOPBACK else host}:{server.get_port()}"


def _guard(server: Any, host: str) -> None:
    """Answer pages of this server only, and tell nobody outside of it."""

    def refused(*args: Any, **options: Any) -> None:
        log.warning("refused a web page's request to share the viewer on the internet")

    server.request_share_url = refused  # would open a tunnel to a host outside
    inner = server._websock_server

    @inner.on_client_connect
    async def _(connection: Any) -> None:
        websocket = inner._live_connections[connection.client_id]
        headers = websocket.request.headers
        if not same_site(headers.get("Origin"), headers.get("Host"), host):
            log.warning("refused a web page of %s access to the viewer", headers.get("Origin"))
            await websocket.close(1008, "another site")


def same_site(origin: str | None, asked: str | None, host: str) -> bool:
    """Whether a page that a browser names as `origin` is our own, reached as `asked`.

    A program that is no browser names none. On the loopback only its own names count: another
    site's name may have been made to lead here.
    """
    if host in LOOPBACK and urlsplit(f"//{asked}").hostname not in LOOPBACK:
        return False
    return origin is None or urlsplit(origin).netloc == asked


def _require_port(host: str, port: int) -> None:
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family[0], socket.SOCK_STREAM) as tried:
            tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            tried.bind(family[4])
    except (OSError, OverflowError):
        raise _taken(host, port) from None


def _taken(host: str, port: int) -> UserError:
    return UserError(
        f"{host}:{port} is in use or not available; pass another port, or 0 for any free port",
        "port",
    )


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """A block in which viser's own lines are dropped."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield


# A training in browsers, as it goes: photograph beside render, curves, and a button that ends it.
#
# It lives in the training's own thread, between steps: what browsers do never waits for it, and
# what it costs is bounded. All who look see the same.


SIZE = 192  # pixels along a picture, at most
EVERY = 3.0  # seconds between pictures, at least
SHARE = 0.05  # of the time that pictures may take; the longer one takes, the rarer they are
ENDING = "Training ends early: the remaining stages are shortened."
BEHIND = 32  # of 255, around the pictures


@contextlib.contextmanager
def watched(host: str, port: int, title: str) -> Iterator[Spectators]:
    """A block in which browsers may look at a training; errors as of `hosted`."""
    with hosted(host, port, f"{title}, training") as server:
        # Beside the picture; not every viser has it
        if panel := getattr(server.gui, "main_panel", None):
            panel.dock_right()
        yield Spectators(server, address_of(server, host))


class Spectators:
    """Who looks at a training. Nothing that goes wrong here reaches it."""

    def __init__(self, server: Any, address: str) -> None:
        """With viser's server, and the address that browsers find it at."""
        self.address: str = address
        self._server = server
        self._photos: Photos | None = None
        self._next = 0.0  # when a picture is due
        self._asked = threading.Event()  # to end the training
        self._failed = False
        self._stage: int | None = None
        self._losses: list[list[tuple[float, float]]] = []
        self._qualities: list[list[tuple[float, float]]] = []
        self._ends: list[float] = []
        gui = server.gui
        self._status = gui.add_markdown("Reading and preparing photographs.")
        self._share = gui.add_progress_bar(0.0)
        self._choice = gui.add_dropdown("photograph", ("",), initial_value="")
        self._curves = gui.add_html("")
        button = gui.add_button("end training and keep the result", color="red")
        self._choice.on_update(lambda event: self._hasten())
        button.on_click(lambda event: self.stop())

    def show(self, photos: Photos) -> None:
        """Offer the photographs that are trained on."""
        self._photos = photos
        with self._guarded():
            self._choice.options = tuple(photos.names)
            self._choice.value = photos.names[0]

    def stop(self) -> None:
        """Ask for the end of training: it comes after the present step."""
        self._asked.set()
        with self._guarded():
            self._status.content = ENDING

    def look(self, scene: Scene, clock: Clock) -> None:
        """Between steps: end the stage where that was asked for; show a picture where one is due
        and somebody looks. The scene and the random numbers stay as they are."""
        if self._asked.is_set() and not clock.finished:
            clock.finish()
            log.info("training ends early: the remaining stages are shortened")
        if self._failed or time.monotonic() < self._next:
            return
        begin = time.monotonic()
        with self._guarded():
            clients = self._server.get_clients()
            if clients and self._photos is not None:
                self._send(clients, self._picture(scene, clock, self._photos))
        end = time.monotonic()
        self._next = end + max(EVERY, (end - begin) / SHARE)

    def tell(self, now: TrainingProgress) -> None:
        """Take in a report of the training: its curves, stage and time."""
        with self._guarded():
            if now.stage != self._stage:
                self._stage = now.stage
                self._losses.append([])
                self._qualities.append([])
                if len(self._losses) > 1:
                    self._ends.append(now.seconds)
            if now.losses:
                self._losses[-1].append((now.seconds, sum(now.losses.values())))
            if now.held_out_psnr is not None:
                self._qualities[-1].append((now.seconds, now.held_out_psnr))
            curves = (
                Curve("loss", self._losses, logarithmic=True),
                Curve("validation PSNR, dB", self._qualities),
            )
            self._curves.content = "".join(chart(curve, self._ends) for curve in curves)
            self._share.value = 100 * now.share
            self._status.content = words(now, self._asked.is_set())

    def _picture(self, scene: Scene, clock: Clock, photos: Photos) -> np.ndarray:
        """The chosen photograph and LAYERS from there, side by side: [H, W, 3] uint8."""
        view = photos.names.index(self._choice.value)
        with torch.random.fork_rng(devices=[]), torch.no_grad():
            cameras = scene.registered(photos).cameras.of(torch.tensor([view]))
            share = min(1.0, SIZE / max(cameras.size(0)))
            cameras = resize(cameras, max(1, round(share * cameras.width)))
            layers = frame(scene, cameras, *shown(clock), view)
        photograph = linear_to_srgb(shrunk(photos, view, *cameras.size(0))[..., :3])
        return labelled(torch.cat([photograph, layers], 1), ("photograph", *LAYERS))

    def _send(self, clients: Mapping[int, Any], picture: np.ndarray) -> None:
        """Show a picture to all; who cannot be reached is left out."""
        for client in clients.values():
            try:
                client.scene.set_background_image(fitted(picture, client.camera.aspect))
            except Exception as error:  # gone in between, or broken: its own affair
                log.debug("a browser could not be reached: %s", error)

    def _hasten(self) -> None:
        """Let the next picture come soon, since another is chosen; not sooner than SHARE allows."""
        self._next = min(self._next, time.monotonic() + 0.5)

    @contextlib.contextmanager
    def _guarded(self) -> Iterator[None]:
        """A block whose faults end what is shown, and not the training."""
        try:
            yield
        except UserError as error:  # such as no surface yet
            log.debug("the training could not be rendered: %s", error)
        except Exception:
            self._failed = True
            log.exception("the view of the training failed and is closed; training continues")


def words(now: TrainingProgress, asked: bool) -> str:
    """How far a training is, as Markdown."""
    left = f"about {now.remaining / 60:.0f}:{now.remaining % 60:02.0f} left"
    quality = "" if now.held_out_psnr is None else f", validation {now.held_out_psnr:.1f} dB"
    text = f"{now.name}, stage {now.stage} of {now.stages}, {now.share:.0%}, {left}{quality}."
    text = text[0].upper() + text[1:]
    return html.escape(text) + (f" {ENDING}" if asked else "")


def fitted(picture: np.ndarray, aspect: float) -> np.ndarray:
    """A picture [H, W, 3] uint8 in the middle of a window of another aspect, width over height."""
    height, width = picture.shape[:2]
    if not 0.05 < aspect < 20:  # no window yet
        return picture
    high, wide = max(height, round(width / aspect)), max(width, round(height * aspect))
    top, left = (high - height) // 2, (wide - width) // 2
    around = ((top, high - height - top), (left, wide - width - left), (0, 0))
    return np.pad(picture, around, constant_values=BEHIND)
