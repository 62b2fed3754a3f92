"""View and relight a trained scene in a browser: live, or as a web page."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from univoxel.cli.parsing import File, Run, Title, takes, written
from univoxel.core import log
from univoxel.errors import UserError

PAGE = "index.html"  # in the folder of a run, written at the end of `univoxel train`


@dataclass(frozen=True)
class ViewOptions:
    run: Run
    """folder of a trained run"""
    html: Annotated[File | None, written("FILE.html", "a server")] = None
    """write a page that works offline, instead of starting the server"""
    envmap: Annotated[tuple[File, ...], written("MAP [MAP ...]", "the built-in maps")] = ()
    """additional environment maps to offer"""
    title: Title = None
    """heading of the page"""
    host: Annotated[str, written("ADDRESS")] = "127.0.0.1"
    """address to listen on; with 127.0.0.1, only this machine can connect"""
    port: Annotated[int, written("N")] = 8080
    """port to listen on; 0: any free port"""


@takes(ViewOptions)
def command(asked: ViewOptions) -> Path | None:
    """View and relight a run in a browser, or write a web page.

    Returns:
        The page, which is written atomically; None if a server was started instead.

    Raises:
        UserError: the run or a map cannot be used, there is no surface, or the port is in use.
        MissingExtra: the server needs viser, which is not installed.
        OSError: a file cannot be read or written.
    """
    from univoxel.detail.texture import page_options
    from univoxel.output.page import PageOptions, write_page

    if asked.html is not None:
        options = {"envmaps": asked.envmap, "title": asked.title} | page_options(asked.run)
        return write_page(asked.run, asked.html, **options)
    from univoxel.viewer.server import serving
    from univoxel.viewer.viewer_scene import subject_of

    page = PageOptions(asked.title, asked.envmap, **page_options(asked.run))
    with serving(subject_of(Path(asked.run)), page, asked.host, asked.port) as address:
        log.info(f"Open {address} in a browser (Ctrl-C stops the server)")
        try:
            threading.Event().wait()
        except KeyboardInterrupt:
            log.info("stopped")
    return None


def with_page(run: Path) -> Path:
    """Write the page of a run into its folder and log its path, or log why that failed.

    Returns:
        The run.
    """
    from univoxel.detail.texture import page_options
    from univoxel.output.page import write_page

    try:
        page = write_page(run, run / PAGE, **page_options(run))
        log.info(f"Page: open {page} in a browser")
        log.info(f"Next: univoxel view {run}, or univoxel export {run} --mesh FILE.glb")
    except (UserError, OSError) as error:  # the training is done and saved
        log.warning(f"the web page was not written: {error}")
    return run
