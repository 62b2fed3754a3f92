"""Prepares images and masks for structure from motion from files of any kind."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import maximum_filter

from univoxel.capture.photographs import SIDEWAYS, Photograph, describe, fitted, read_upright
from univoxel.core.files import replacing
from univoxel.data.images import upright_from_stored
from univoxel.data.masks import laid_over, masks_in
from univoxel.errors import DataError

SFM_QUALITY = 95  # of JPEG
MASK_MARGIN = 0.006  # that masks grow by before features are sought, of the longer side


class Folders:
    """Where the work of one capture lies, all below one folder."""

    def __init__(self, work: Path) -> None:
        self.work: Path = work
        self.frames: Path = work / "frames"  # of a video
        self.pictures: Path = work / "pictures"
        self.masks: Path = work / "masks"
        self.database: Path = work / "database.db"
        self.pairs: Path = work / "pairs.txt"
        self.models: Path = work / "models"


@dataclass(frozen=True)
class Capture:
    """Photographs in order of their names, and which of them share a camera."""

    photographs: list[Photograph]
    groups: list[list[int]]
    masks: list[Path] | None = None  # one for each photograph

    @property
    def pictures(self) -> list[str]:
        """Names of the pictures for structure from motion, a folder a camera: without blanks."""
        camera = {i: g for g, members in enumerate(self.groups) for i in members}
        return [f"{camera[i]}/{i:05d}.jpg" for i in range(len(self.photographs))]


def gather(files: Sequence[Path], masks: Path | None) -> tuple[Capture, list[str]]:
    """What was photographed with what, and names of files that cannot be read; a DataError where a
    photograph lacks its mask, or there are fewer than two photographs."""
    photographs, unread = [], []
    for path in files:
        try:
            photographs.append(describe(path))
        except DataError:
            unread.append(path.name)
    if len(photographs) < 2:
        raise DataError(
            f"{files[0].parent}: expected at least two readable photographs, got {len(photographs)}"
        )
    named = [(photograph.name, photograph.path) for photograph in photographs]
    found = None if masks is None else masks_in(masks, named)
    return Capture(photographs, group(photographs), found), unread


def group(photographs: Sequence[Photograph]) -> list[list[int]]:
    """Indices of photographs with one camera, model, focal length and size; the largest first.

    Portrait and landscape are one camera. Without anything in the file, the size decides.
    """
    groups: dict[tuple, list[int]] = {}
    for i, p in enumerate(photographs):
        key = (p.camera, p.focal, max(p.width, p.height), min(p.width, p.height))
        groups.setdefault(key, []).append(i)
    return sorted(groups.values(), key=lambda g: (-len(g), g[0]))


def in_words(photographs: Sequence[Photograph], groups: Sequence[Sequence[int]]) -> str:
    """What was photographed with what, for people."""
    first = photographs[groups[0][0]]
    portrait = sum(p.portrait for p in photographs)
    long, short = max(first.width, first.height), min(first.width, first.height)
    told = f"{len(photographs)} photographs"
    if len(groups) == 1:
        told += f" from {first.camera} ({long}x{short})" if first.camera else f" ({long}x{short})"
    else:
        zooms = {photographs[g[0]].focal for g in groups}
        sizes = {tuple(sorted((p.width, p.height))) for p in photographs}
        cameras = {p.camera for p in photographs}
        of = [
            f"{len(found)} {what}"
            for found, what in ((cameras, "models"), (zooms, "zoom settings"), (sizes, "sizes"))
            if len(found) > 1
        ]
        told += f" from {len(groups)} cameras ({', '.join(of)})"
    if 0 < portrait < len(photographs):
        told += f", {portrait} of them in portrait orientation"
    return told


def to_landscape(picture: Image.Image) -> Image.Image:
    """A portrait picture turned counter-clockwise by 90 degrees; others as they are.

    Held either way it is one camera, but structure from motion knows one size a camera.
    `scene.own_sizes` turns its poses back.
    """
    if picture.height <= picture.width:
        return picture
    return picture.transpose(Image.Transpose.ROTATE_90)


def write_pictures(
    capture: Capture, folders: Folders, size: int
) -> Iterator[tuple[int, str | None]]:
    """Write pictures and masks for structure from motion, those that are not there.

    Upright, then portrait turned to landscape; masks grown by a margin. Yields the index of each
    photograph, and why it cannot be read.
    """
    jobs = list(enumerate(capture.pictures))
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        running = {
            pool.submit(_write_picture, capture, folders, i, name, size): i for i, name in jobs
        }
        try:
            for job in as_completed(running):
                yield running[job], job.result()
        finally:
            pool.shutdown(cancel_futures=True)


def read_mask(capture: Capture, index: int) -> Image.Image:
    """The mask of a photograph, upright, of its own size, grey; a DataError as in `laid_over`."""
    assert capture.masks is not None
    path, photograph = capture.masks[index], capture.photographs[index]
    width, height = photograph.width, photograph.height
    if photograph.turned in SIDEWAYS:
        width, height = height, width
    mask = laid_over(path, width, height, photograph.path, upright=True)
    if mask.is_floating_point():
        mask = (255 * mask).round().byte()
    return Image.fromarray(upright_from_stored(mask, photograph.turned).contiguous().numpy())


def _write_picture(
    capture: Capture, folders: Folders, index: int, name: str, size: int
) -> str | None:
    photograph = capture.photographs[index]
    target = folders.pictures / name
    target.parent.mkdir(parents=True, exist_ok=True)
    if not target.exists():
        try:
            picture = to_landscape(read_upright(photograph.path, size).convert("RGB"))
        except DataError as error:
            return str(error)
        with replacing(target) as temporary:
            picture.save(temporary, format="JPEG", quality=SFM_QUALITY)
    if capture.masks is not None:
        target = folders.masks / f"{name}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        if not target.exists():
            mask = read_mask(capture, index)
            # Of another size it would not be scaled, but laid into the picture's corner
            mask = mask.resize(fitted(photograph.width, photograph.height, size))
            object_ = np.asarray(mask) > 127
            grown = maximum_filter(object_, 2 * round(MASK_MARGIN * max(mask.size)) + 1)
            with replacing(target) as temporary:
                to_landscape(Image.fromarray(255 * grown.astype(np.uint8))).save(
                    temporary, format="PNG"
                )
    return None
