"""A trained scene to look at and to light: in a browser, live, or as one web page."""

from __future__ import annotations

import logging
import threading
from collections.abc import Sequence
from pathlib import Path

from univoxel.errors import UserError
from univoxel.page import PageOptions, write_page

PAGE = "index.html"  # in the folder of a run, written at the end of `univoxel train`

log: logging.Logger = logging.getLogger("univoxel")


def view(
    run: str | Path,
    html: str | Path | None = None,
    *,
    envmap: Sequence[str | Path] = (),
    title: str | None = None,
    host: str = "127.0.0.1",
    port: int = 8080,
) -> Path | None:
    """Serve a run to browsers until interrupted; or write it as one page that needs no network.

    Args:
        run: folder of the trained run.
        html: the page, written whole or not at all; None: no page, but a server.
        envmap: maps to offer besides the recovered one and the usual ones.
        title: of the page; None: the run folder's name.
        host: that the server listens on: its default is reached from this machine alone.
        port: that it listens on; 0: any free one.

    Returns:
        The page's path; None of a server, after it has ended.

    Raises:
        UserError: the run or a map cannot be used, there is no surface, or the port is taken.
        MissingExtra: viser is missing, which the server needs.
        OSError: a file cannot be read or written.
    """
    if html is None:
        from univoxel.viewer.server import serving
        from univoxel.viewer.subject import subject_of

        options = PageOptions(title=title, envmaps=envmap)
        with serving(subject_of(Path(run)), options, host, port) as address:
            log.info(f"to look at, in a browser: {address} (Ctrl-C ends it)")
            try:
                threading.Event().wait()
            except KeyboardInterrupt:
                log.info("ended")
        return None
    return write_page(run, html, envmaps=envmap, title=title)


def with_page(run: Path) -> Path:
    """Write the page of a run into its folder and name it; say so where it cannot be done.

    Returns:
        The run.
    """
    try:
        page = write_page(run, run / PAGE)
        log.info(f"to look at, in a browser: {page}")
    except (UserError, OSError) as error:  # the training is done and saved
        log.warning(f"no page was written: {error}")
    return run
