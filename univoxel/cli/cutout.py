"""Cut the object out of photographs without masks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from univoxel.cli.parsing import BoxOf, DownscaleBy, check_downscale, takes, written
from univoxel.core.choices import NETWORK, NetworkName


@dataclass(frozen=True)
class CutoutOptions:
    data: Annotated[Path, written("DATA", positional=True)]
    """folder of the photographs and their cameras; masks in it are not looked at"""
    out: Annotated[Path, written("DIR")]
    """folder to write"""
    source: Annotated[str, written("rembg|FOLDER|none", "rembg", name="from")] = "rembg"
    """where masks come from: rembg, a network on single photographs; a folder of masks; or none,
    depth alone: what stands out from its support, in the middle of what the cameras look at. Masks
    that contradict the object in 3D are repaired"""
    network: NetworkName = NETWORK
    """which of rembg's networks makes them: the further down the list, the more megabytes, time and
    detail"""
    box: BoxOf = None
    """lower and upper corner, in world units of the written cameras, of a box that the object lies
    in; outside of it nothing counts"""
    keep_table: bool = False
    """with --from none and a box: what stands out keeps its support, within the box"""
    downscale: DownscaleBy = "auto"
    """write photographs of 1/N of their width and height; auto as of train"""
    allow_outside: bool = False
    """as of train"""


@takes(CutoutOptions)
def command(asked: CutoutOptions) -> Path:
    """Cut the object out of photographs without masks.

    Writes them with their alpha, and their cameras, as a new folder to train on: look at its
    masks.html, worst first, and mend what is wrong in any image editor.
    """
    from univoxel.capture.cutout import cutout

    downscale = check_downscale(asked.downscale)
    return cutout(
        *(asked.data, asked.out, asked.source, downscale, asked.allow_outside),
        network=asked.network,
        box=asked.box,
        keep_table=asked.keep_table,
    )
