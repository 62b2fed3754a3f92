"""A server of viser's that answers one machine's pages alone, and leaves nothing behind."""

from __future__ import annotations

import contextlib
import io
import logging
import socket
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

from univoxel.errors import MissingExtra, UserError

HOST = "127.0.0.1"
PORT = 8080
LOOPBACK = ("127.0.0.1", "localhost", "::1")

log: logging.Logger = logging.getLogger("univoxel")


@contextlib.contextmanager
def hosted(host: str, port: int, title: str) -> Iterator[Any]:
    """A block in which a server answers browsers; gives it. Nothing of it is left afterwards.

    Raises:
        MissingExtra: viser is not installed.
        UserError: the port is taken.
    """
    try:
        import viser
    except ImportError:
        raise MissingExtra("the viewer needs viser: pip install 'univoxel[view]'") from None
    _require_port(host, port)
    with _silent():
        server = viser.ViserServer(host=host, port=port, verbose=False)
    try:
        if port and server.get_port() != port:  # taken in between; viser goes on to the next
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
    """Answer pages of this server alone, and tell nobody outside of it."""

    def refused(*args: Any, **options: Any) -> None:
        log.warning("a page asked to share the viewer with the network: refused")

    server.request_share_url = refused  # would open a tunnel to a host outside
    inner = server._websock_server

    @inner.on_client_connect
    async def _(connection: Any) -> None:
        websocket = inner._live_connections[connection.client_id]
        headers = websocket.request.headers
        if not same_site(headers.get("Origin"), headers.get("Host"), host):
            log.warning("a page of %s asked for the viewer: refused", headers.get("Origin"))
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
        f"{host}:{port} is taken or cannot be listened on; give another port, or 0 for a free one",
        "port",
    )


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """A block in which viser's own lines are dropped."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield
