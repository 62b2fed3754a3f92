"""Masks for photographs whose cameras are known."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from univoxel.cli.parsing import BoxOf, DownscaleBy, check_downscale, takes, written
from univoxel.core.choices import NETWORK, NetworkName


@dataclass(frozen=True)
class CutoutOptions:
    data: Annotated[Path, written("DATA", positional=True)]
    """folder with the photographs and their cameras; its masks are ignored"""
    out: Annotated[Path, written("DIR")]
    """folder to write to"""
    source: Annotated[str, written("rembg|FOLDER|none", "rembg", name="from")] = "rembg"
    """source of the masks: rembg (a network), none (depth maps), or a folder of masks"""
    network: NetworkName = NETWORK
    """network that makes the masks; those listed later are slower but more accurate"""
    box: BoxOf = None
    """corners of a box around the object, in world coordinates of the written cameras"""
    keep_table: bool = False
    """keep the part of the table that is inside the box; needs --from none"""
    downscale: DownscaleBy = "auto"
    """write photographs at 1/N of their size; auto: longer side of about 1000 pixels"""
    allow_outside: bool = False
    """also read files outside the folder if the data set refers to them"""


@takes(CutoutOptions)
def command(asked: CutoutOptions) -> Path:
    """Make masks for photographs whose cameras are known.

    Writes photographs with an alpha channel and their cameras to a new folder, which you can train
    on. Check its masks.html, which lists the worst masks first; fix wrong masks in an image editor.
    """
    from univoxel.capture.cutout import cutout

    downscale = check_downscale(asked.downscale)
    return cutout(
        *(asked.data, asked.out, asked.source, downscale, asked.allow_outside),
        network=asked.network,
        box=asked.box,
        keep_table=asked.keep_table,
    )
