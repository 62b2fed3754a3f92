"""A trained scene to look at and to light, as one web page."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from univoxel.errors import UserError
from univoxel.page import write_page

PAGE = "index.html"  # in the folder of a run, written at the end of `univoxel train`

log = logging.getLogger("univoxel")


def view(
    run: str | Path,
    html: str | Path | None = None,
    *,
    envmap: Sequence[str | Path] = (),
    title: str | None = None,
) -> Path:
    """Write a run as one page that needs no other file and no network; return its path.

    Args:
        run: folder of the trained run.
        html: the page, written whole or not at all.
        envmap: maps to offer besides the recovered one and the usual ones.
        title: of the page; None: the run folder's name.

    Raises:
        UserError: the run or a map cannot be used, there is no surface, or html is missing.
        OSError: a file cannot be read or written.
    """
    if html is None:
        raise UserError("view: expected html=FILE.html, the page to write", "html")
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
